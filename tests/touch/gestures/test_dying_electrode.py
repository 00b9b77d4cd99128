"""An electrode that fails during a touch on a simulated skin: the touch does not end and is marked as cut off."""

import jax
import numpy as np
import pytest

from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import one_step
from jeit.layout import perimeter
from jeit.mesh import Rectangle
from jeit.protocol import reference_electrode
from jeit.touch import TouchLevel, find_touches
from jeit.touch.simulate import DiscIndenter, MovingPress, PressedSkin, material

KEY, FRAMES = jax.random.key(0), 64


@pytest.fixture(scope="module")
def recorded():
    """Images of change of a push of 0.2 s, and the same with the third electrode's channels dead from the middle on."""
    outline = Rectangle(0.32, 0.2)
    places = np.vstack([perimeter(Rectangle(0.3, 0.18), 8, start=0.06), [[0.0, 0.0]]])
    model = ForwardModel(outline.mesh(num_points=250), PointElectrodes(places), reference_electrode(8))
    own = material("conductive fabric")
    skin, linear = PressedSkin(KEY, model, own), one_step(model, own.conductivity * own.thickness)
    seconds = np.arange(FRAMES) / 60
    load = 3 * np.sin(np.pi * np.clip((seconds - 0.2) / 0.2, 0, 1))
    film = skin.record(KEY, MovingPress(DiscIndenter(0.03), load, (0.06, 0.02)), seconds)
    quiet = skin.record(jax.random.key(1), [], np.arange(60) / 60)
    reference = quiet.mean(axis=0)
    level = TouchLevel.of_untouched(model.mesh, np.asarray(linear.image(quiet - reference)))
    drives = np.asarray(model.protocol.drive)[np.asarray(model.protocol.drive_index)]
    reads = np.asarray(model.protocol.measurement)[np.asarray(model.protocol.measurement_index)]
    dead = film.copy()
    dead[18:, (drives[:, 2] != 0) | (reads[:, 2] != 0)] = 0.0
    return level, seconds, *(np.asarray(linear.image(one - reference)) for one in (film, dead))


@pytest.mark.slow
def test_a_push_is_one_touch_that_ends(recorded):
    level, seconds, images, _ = recorded
    (touch,) = find_touches(level, seconds, images)
    assert touch.whole
    assert 0.2 < touch.onset < 0.25
    assert 0.35 < touch.offset < 0.9


@pytest.mark.slow
def test_if_an_electrode_fails_it_does_not_end(recorded):
    level, seconds, images, dead = recorded
    whole, broken = (find_touches(level, seconds, one)[-1] for one in (images, dead))
    assert broken.cut_off
    assert broken.offset == seconds[-1]
    assert broken.course.peak.max() > 3 * whole.course.peak.max()
