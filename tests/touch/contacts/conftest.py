"""A simulated skin, on a finer mesh than its images, and its readings."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import one_step
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch.contacts import ImageNoise
from jeit.touch.simulate import DiscIndenter, Press, PressedSkin, material


@pytest.fixture(scope="session")
def skin():
    """Frames of two contacts, of one at the centre, and of none: readings, images, and the known noise."""
    electrodes = BoundaryElectrodes(ring(0.05, 16), 0.008, 300.0)
    fine, coarse = (ForwardModel(Disk(0.05).mesh(num_points=n), electrodes, adjacent(16)) for n in (1200, 700))
    pressed = PressedSkin(jax.random.key(0), fine, material("velostat"))
    empty = pressed.frames(jax.random.key(1), [()] * 1100)
    before, reference = empty[1000:], empty[1000:].mean(axis=0)
    reconstruction = one_step(coarse, float(pressed.conductivity[0]), noise=before.std(axis=0))
    two = (Press(DiscIndenter(0.008), 1.0, (0.025, 0.0)), Press(DiscIndenter(0.008), 2.0, (-0.02, 0.01)))
    touched = pressed.touched([two, Press(DiscIndenter(0.0115), 1.0, (0.01, 0.005))])
    change = np.zeros((2, fine.mesh.num_cells))
    np.add.at(change, (np.arange(2)[:, None], np.asarray(touched.cells)), np.asarray(touched.change))
    exact = np.stack([np.asarray(fine.voltages(pressed.conductivity * (1 + one))) for one in change])
    frames = pressed.read(jax.random.key(2), exact, np.zeros(1))
    return SimpleNamespace(
        mesh=coarse.mesh,
        reconstruction=reconstruction,
        before=before,
        reference=reference,
        empty=np.asarray(reconstruction.image(empty[:1000] - reference)),
        noise=ImageNoise.of_frames(reconstruction, before),
        two=np.asarray(reconstruction.image(frames[0] - reference)),
        one=np.asarray(reconstruction.image(frames[1] - reference)),
        change=frames[1] - reference,
    )
