"""Sensors with a moving touch, and the frames that they measure.

The sensors are the sheet of Silvera Tawil et al. 2011 (320 × 200 mm, 16 electrodes along the edge and one at the
centre, 224 voltages) and a disk of 16 electrodes (208 voltages).
"""

from __future__ import annotations

NOISE = 1e-3  # standard deviation, of each voltage


def bodies():
    """For each sensor by name, a function that creates the forward model for a number of nodes, and half of the extents
    of a touch's path along x and y, in metres."""
    import numpy as np

    from jeit.electrodes import BoundaryElectrodes, CombinedElectrodes, SheetDiscs
    from jeit.forward import ForwardModel
    from jeit.layout import perimeter, ring
    from jeit.mesh import Disk, Rectangle, Refine
    from jeit.protocol import adjacent, reference_electrode

    def sheet(num_points):
        outline = Rectangle(0.32, 0.2)
        edge = BoundaryElectrodes(perimeter(outline, 16), 0.01, 1e-3)
        electrodes = CombinedElectrodes(edge, SheetDiscs(np.zeros((1, 2)), 0.006, 1e-3))
        return ForwardModel(outline.mesh(num_points=num_points), electrodes, reference_electrode(16))

    def disk(num_points):
        electrodes = BoundaryElectrodes(ring(0.1, 16), 0.012, 1e-3)
        refine = Refine(np.asarray(electrodes.position), factor=2.0)
        return ForwardModel(Disk(0.1).mesh(num_points=num_points, refine=refine), electrodes, adjacent(16))

    return {"sheet, 16 + 1 electrodes": (sheet, (0.1, 0.06)), "disk, 16 electrodes": (disk, (0.06, 0.06))}


def simulate(model, reach, count: int):
    """Frames (count, channels) of a touch that moves over the body and halves the conductivity within 15 mm, and a
    frame of the untouched body."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jeit.mesh import centroids

    centre, rest = centroids(model.mesh), model.voltages(1.0)
    angle = jnp.linspace(0, 2 * jnp.pi, count)
    places = jnp.stack([reach[0] * jnp.cos(angle), reach[1] * jnp.sin(3 * angle)], axis=1)

    def frame(place, key):
        touched = jnp.sum((centre - place) ** 2, axis=1) < 0.015**2
        voltages = model.voltages(jnp.where(touched, 0.5, 1.0))
        return voltages + NOISE * jnp.abs(rest) * jax.random.normal(key, rest.shape)

    keys = jax.random.split(jax.random.key(0), count)
    frames = jax.lax.map(lambda pair: frame(*pair), (places, keys))
    return np.asarray(frames), np.asarray(rest)
