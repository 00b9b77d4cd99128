"""A square skin with 14 places to press, after Russo et al. 2017, flat and bent to a radius of 3 cm.

Bending a sheet without thickness changes no voltage. In a layer 5 mm thick it stretches the touched side by a sixth.
The presses on the bent skin are classified by a model trained on the bent skin and by one trained on the flat skin. See
`bent_sheet.png`. Takes 20 s and 0.8 GB on two cores.
"""

import matplotlib.pyplot as plt
import numpy as np
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from jeit.design import Bell, Skin
from jeit.layout import SurfaceLayout, grid
from jeit.mesh import Mesh, Rectangle, bend
from jeit.plot import ColourScale, plot_curved_skin
from jeit.protocol import opposite

SIDE, RADIUS, THICKNESS = 0.13, 0.03, 5e-3  # metres
JITTER, NOISE = 1e-3, 1e-5  # metres, volts


def rolled(places, above: float = 0.0) -> np.ndarray:
    """Positions on the bent sheet, or at a height above it, of places (n, 2) of the flat sheet, metres."""
    radius, angle = RADIUS + above, places[:, 0] / RADIUS
    return np.column_stack([radius * np.sin(angle), places[:, 1], radius * np.cos(angle) - RADIUS])


def flat(places, above: float = 0.0) -> np.ndarray:
    """Positions on the flat sheet, or at a height above it, of places (n, 2), metres."""
    return np.column_stack([places, np.full(len(places), above)])


def features(skin: Skin, lay, places, rng) -> np.ndarray:
    """Voltage changes by a press at each place, displaced at random by 1 mm and 1.5 or 2.5 mm deep, relative to the
    voltages' root mean square."""
    pressed = lay(places + JITTER * rng.normal(size=places.shape), THICKNESS)
    deeper = rng.permutation(np.arange(len(places)) % 2 == 0)
    changes = np.zeros((len(places), skin.model.protocol.num_measurements))
    for some, depth in ((~deeper, 1.5e-3), (deeper, 2.5e-3)):
        changes[some] = skin.voltage_changes(skin.touched_cells(pressed[some], Bell(depth, 6e-3)))
    changes += NOISE * rng.normal(size=changes.shape)
    return changes / np.sqrt(np.mean(np.asarray(skin.model.voltages(skin.model_conductivity)) ** 2))


def main() -> float:
    rng = np.random.default_rng(0)
    plane = Rectangle(SIDE, SIDE).mesh(cell_size=6.5e-3)
    centres = np.delete(grid(0.104, 0.104, 5, 5), [6, 7, 8, 11, 12, 13, 16, 17, 18], axis=0)  # 16 along the edge
    places = np.concatenate([grid(0.085, 0.05, 5, 2), grid(0.06, 0.0, 4, 1)])  # 14
    label = np.repeat(np.arange(len(places)), 10)
    lying = Mesh.create(flat(np.asarray(plane.points)), plane.cells)
    skins = {}
    for name, mesh, lay in (("flat", lying, flat), ("bent", bend(plane, RADIUS), rolled)):
        layout = SurfaceLayout(lay(centres), 9e-3, mesh, contact_impedance=1e-4, name=name)
        options = {"thickness": THICKNESS, "num_layers": 3, "protocol": opposite(16)}
        skins[name] = Skin.create(layout, **options), lay
    models = {
        name: LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(
            features(skin, lay, places[label], rng), label
        )
        for name, (skin, lay) in skins.items()
    }
    asked = np.repeat(np.arange(len(places)), 6)
    tested = {name: features(skin, lay, places[asked], rng) for name, (skin, lay) in skins.items()}
    right = {
        f"trained {a}, tested {b}": float(np.mean(models[a].predict(tested[b]) == asked))
        for a, b in (("flat", "flat"), ("bent", "bent"), ("flat", "bent"))
    }
    figure, (space, bars) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", width_ratios=(3, 2))
    layout = skins["bent"][0].layout
    plot_curved_skin(layout, marks={"pressed": rolled(places)}, title="Bent to 3 cm", scale=ColourScale(), ax=space)
    bars.barh(list(right), [100 * share for share in right.values()], color="#1f6fb4")
    bars.set_xlabel("presses classified correctly (%)")
    bars.set_xlim(0, 100)
    bars.spines[["top", "right"]].set_visible(False)
    figure.savefig("bent_sheet.png", dpi=120)
    for condition, share in right.items():
        print(f"{condition}: {100 * share:.0f} %")
    return 1 - right["trained bent, tested bent"]


if __name__ == "__main__":
    wrong = main()
    assert wrong < 0.05
