"""Contacts in images of a pressed skin, after Chen et al. 2022: processing steps, two weights, errors, load curve and
strokes.

See `contacts_from_images.png`. Takes 15 s and 0.8 GB on two cores.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import back_projection, one_step
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch import (
    CellFinder,
    DiscIndenter,
    ImageNoise,
    MovingPress,
    Press,
    PressedSkin,
    RasterFinder,
    find_contacts,
    material,
    plot_contact_stages,
    plot_contacts,
    track_contacts,
)

GRAMS = np.array([100, 300, 700, 1200, 2000, 3000, 3900])


def main() -> float:
    electrodes = BoundaryElectrodes(ring(0.05, 16), width=0.008, contact_impedance=300.0)
    fine, coarse = (ForwardModel(Disk(0.05).mesh(num_points=n), electrodes, adjacent(16)) for n in (3000, 900))
    skin = PressedSkin(jax.random.key(0), fine, material("velostat"))
    conductivity = float(skin.conductivity[0])
    before = skin.frames(jax.random.key(1), [()] * 100)
    methods = {
        "one-step": one_step(coarse, conductivity, noise=before.std(axis=0)),
        "back-projection": back_projection(coarse, conductivity),
    }
    noise = {name: ImageNoise.of_frames(one, before) for name, one in methods.items()}
    finder = CellFinder(coarse.mesh)

    def found(name, frames):
        images = np.asarray(methods[name].image(frames - before.mean(axis=0)))
        return images, [find_contacts(finder, image, noise[name]) for image in images]

    def weight(grams, place, radius=0.0115):
        return Press(DiscIndenter(2 * radius), 9.81e-3 * grams, place)

    radii, turns = np.arange(0, 0.0401, 0.005), np.radians([0, 45, 90])
    places = np.array([[r * np.cos(a), r * np.sin(a)] for a in turns for r in radii])
    circle = [weight(100, (0.03 * np.cos(a), 0.03 * np.sin(a))) for a in np.arange(16) * np.pi / 8]
    presses = [
        *(weight(100, place) for place in places),
        *(weight(grams, (0, 0), 0.016) for grams in GRAMS),
        *circle,
        (weight(100, (0.02, 0.0), 0.008), weight(100, (-0.018, 0.030), 0.008)),
        (weight(100, (-0.025, 0.0), 0.008), weight(200, (0.025, 0.0), 0.008)),
    ]
    frames = skin.frames(jax.random.key(2), presses)
    figure = plt.figure(figsize=(15, 8), layout="constrained")
    stages, graphs = figure.subfigures(2, 1, height_ratios=(3, 5))
    of_place, of_load, two, moved = graphs.subplots(1, 4)
    ends = np.cumsum([len(places), len(GRAMS), 16])
    worst = 0.0
    for name in methods:
        images, contacts = found(name, frames)
        parts = np.split(np.array([one[0].peak for one in contacts]), ends)
        off = np.array([np.linalg.norm(one[0].centroid - place) for one, place in zip(contacts, places, strict=False)])
        of_place.plot(1e3 * radii, 1e3 * off.reshape(3, -1).mean(axis=0), "o-", label=name)
        of_load.plot(1e-3 * GRAMS, parts[1] / parts[1][0], "o-", label=name)
        assert (np.diff(parts[1]) > 0).all()
        assert np.abs(parts[2] / parts[2].mean() - 1).max() < 0.1
        assert [len(one) for one in contacts[-2:]] == [2, 2]
        assert contacts[-1][0].centroid[0] > 0  # the heavier weight gives the stronger contact
        if name == "one-step":
            worst = float(off.max())
            plot_contacts(coarse.mesh, images[-1], contacts[-1], title="100 g and 200 g", ax=two)
            raster = RasterFinder(coarse.mesh).stages(images[-2], noise[name])
            plot_contact_stages(raster, axes=stages.subplots(1, 6))

    # No contact is detected on the untouched skin.
    assert not any(found("one-step", skin.frames(jax.random.key(3), [()] * 1000))[1])

    # Two fingers at once, each on its own path.
    seconds = np.arange(30) / 30
    along = np.linspace(-0.025, 0.025, 30)
    strokes = [
        MovingPress(DiscIndenter(0.007), 2.0, np.stack([s * along, s * 0.016 + 0 * along], axis=-1)) for s in (1, -1)
    ]
    touches = track_contacts(seconds, found("one-step", skin.record(jax.random.key(4), strokes, seconds))[1])
    for path in touches:
        moved.plot(*1e3 * path.position.T, ".-", label=f"touch {path.number + 1}, {1e3 * path.length:.0f} mm")
    for number, stroke in enumerate(strokes):
        moved.plot(*1e3 * stroke.position.T, "k--", linewidth=1, label=None if number else "true paths, 50 mm each")
    of_place.set(xlabel="from the middle, mm", ylabel="error, mm (three directions, 100 g)")
    of_load.set(xlabel="load, kg", ylabel="peak over that of 100 g")
    moved.set(xlabel="mm", ylabel="mm", aspect="equal", title="two strokes at once", xlim=(-32, 32), ylim=(-32, 32))
    for ax in (of_place, of_load, moved):
        ax.legend(frameon=False)
    figure.savefig("contacts_from_images.png")
    return worst


if __name__ == "__main__":
    error = main()
    print(f"greatest error: {1e3 * error:.1f} mm; the paper's, on its own skin: 11 mm")
    assert error < 0.011
