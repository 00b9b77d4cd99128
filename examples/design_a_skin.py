"""Compare two layouts of 32 electrodes on a 200 × 200 × 10 mm skin, with touches everywhere; see `design_a_skin.png`.
Takes 8 s and 0.7 GB on two cores."""

from matplotlib.figure import Figure

from jeit.design import Skin, compare_layouts, plot_sensitivity_map, plot_taxels
from jeit.layout import named_layout


def main() -> float:
    skins = [Skin.create(named_layout(name), cell_size=6e-3, num_layers=4) for name in ("park-inner", "park-boundary")]
    result = compare_layouts(skins[0], skins[1], places=32)
    figure = Figure(figsize=(10, 8.4), layout="constrained")
    for row, response in zip(figure.subplots(2, 2), result.responses, strict=True):
        layout = response.layout
        plot_sensitivity_map(response.sensitivity, electrodes=layout.centres, title=layout.name, ax=row[0])
        plot_taxels(response.taxels, electrodes=layout.centres, title="virtual taxels", ax=row[1])
    figure.savefig("design_a_skin.png", dpi=120)
    inner, boundary = result.figures
    for figures in (inner, boundary):
        area = figures["taxel_area_cm2"]
        print(f"{figures['layout']}: taxels of {area['mean']:.1f} ± {area['std']:.1f} cm²")
    print(f"blind spot of the boundary layout: {100 * boundary['blind_spot_fraction']:.0f} % of the area")
    return inner["taxel_area_cm2"]["mean"] / boundary["taxel_area_cm2"]["mean"]


if __name__ == "__main__":
    ratio = main()
    assert ratio < 0.6  # 12.6 against 30.5 cm² in Park et al. 2022
