"""The forearm of a prosthesis, after Park et al. 2022: a tapered layer 10 mm thick on a core with 32 electrodes.

The protocol measures the 94 pairs of electrodes that are nearest to each other along the core. A ball is pressed in at
places all over the layer, and each press is located in an image of the skin. See `prosthesis.png`. Takes 15 s and 0.7
GB on two cores.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jeit.design import Hemisphere, Skin, plot_unrolled, touches_away_from_the_edge
from jeit.inverse import one_step
from jeit.layout import SurfaceLayout
from jeit.mesh import Geodesics, forearm, unroll
from jeit.plot import Camera, ColourScale, plot_curved_skin
from jeit.touch import CellFinder, find_contacts

NOISE = 2e-5  # volts, 80 dB below the measured voltages


def main() -> float:
    size = {"length": 0.2, "wrist": (0.026, 0.032), "elbow": (0.040, 0.045)}
    core = forearm(**size, cell_size=5e-3)
    layout = SurfaceLayout.spread(core, 32, 6e-3, margin=6e-3, name="forearm")
    skin = Skin.create(layout, thickness=10e-3, num_layers=5)
    places = touches_away_from_the_edge(skin.outline, 20e-3, 8, 8).places
    pressed = skin.touched_cells(places, Hemisphere(5e-3, 20e-3))
    exact = np.asarray(skin.voltage_changes(pressed))
    changes = exact + NOISE * np.random.default_rng(0).normal(size=exact.shape)

    # Image on a sheet as wide as the core, with its own triangles.
    coarse = SurfaceLayout(layout.centres, 6e-3, forearm(**size, cell_size=6e-3))
    sheet = Skin.create(coarse, num_layers=0)
    imaged = np.asarray(one_step(sheet.model, sheet.model_conductivity, noise=NOISE).image(jnp.asarray(changes)))
    finder = CellFinder(sheet.model.mesh, sign=-1)
    found = np.array([find_contacts(finder, image)[0].centroid for image in imaged])
    # Touches are on the outer face of the layer and images on its core: compare with the nearest point of the core.
    ways = Geodesics.create(sheet.model.mesh)
    error = np.array([ways.distances(one[None], other[None])[0, 0] for one, other in zip(places, found, strict=True)])

    shown, (x, y, _) = 20, places[20]
    camera = Camera(azimuth=float(np.degrees(np.arctan2(y, x))) - 25)
    marks = {"touched": ways.surface.nearest(places[[shown]]).points, "found": found[[shown]]}
    figure, (space, flat) = plt.subplots(1, 2, figsize=(13, 5.6), layout="constrained", width_ratios=(1, 2))
    bare = ColourScale(bar=False)
    plot_curved_skin(coarse, imaged[shown], marks=marks, camera=camera, scale=bare, ax=space, title="The core")
    title = f"Unrolled; {len(places)} touches found to {1e3 * error.mean():.1f} mm on average"
    plot_unrolled(unroll(sheet.model.mesh), imaged[shown], coarse, marks=marks, ax=flat, title=title)
    figure.savefig("prosthesis.png", dpi=120)
    return float(error.mean())


if __name__ == "__main__":
    error = main()
    print(f"mean error {1e3 * error:.1f} mm along the core")
    assert error < 0.006  # metres
