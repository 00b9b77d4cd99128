"""Two layouts of 32 electrodes on a 200 × 200 × 10 mm skin, touched all over; see `design_a_skin.png`."""

import jax
from matplotlib.figure import Figure

from jeit.design import comparison, feel, touches_away_from_the_edge
from jeit.layout import named_layout
from jeit.plot import plot_sensitivity_map, plot_taxels


def main() -> float:
    figure = Figure(figsize=(10, 8.4), layout="constrained")
    felt = []
    for row, name in zip(figure.subplots(2, 2), ("park-inner", "park-boundary"), strict=True):
        layout = named_layout(name)
        grid = touches_away_from_the_edge(layout.known_outline, margin=0.01, columns=32, rows=32)
        felt.append(feel(layout, grid, key=jax.random.key(0), cell_size=6e-3, num_layers=4))
        plot_sensitivity_map(felt[-1].sensitivity, electrodes=layout.centres, title=name, ax=row[0])
        plot_taxels(felt[-1].taxels, electrodes=layout.centres, title="virtual taxels", ax=row[1])
    figure.savefig("design_a_skin.png", dpi=120)
    inner, boundary = comparison(*felt)
    for told in (inner, boundary):
        area = told["taxel_area_cm2"]
        print(f"{told['layout']}: taxels of {area['mean']:.1f} ± {area['std']:.1f} cm²")
    print(f"blind spot of the boundary layout: {100 * boundary['blind_spot_fraction']:.0f} % of the area")
    return inner["taxel_area_cm2"]["mean"] / boundary["taxel_area_cm2"]["mean"]


if __name__ == "__main__":
    ratio = main()
    assert ratio < 0.6  # 12.6 against 30.5 cm² in Park et al. 2022
