"""A long simulated recording of gestures: the skin changes where loads are, and nowhere else."""

import jax
import numpy as np
import pytest
from gesture_skin import PLACES, RATE, SHEET

from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.protocol import reference_electrode
from jeit.touch.simulate import Person, PressedSkin, material, simulate_gesture_stream

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def skin() -> PressedSkin:
    model = ForwardModel(SHEET.mesh(num_points=100), PointElectrodes(PLACES), reference_electrode(8, current=1.8e-3))
    return PressedSkin(KEY, model, material("conductive fabric"))


def test_the_skin_changes_where_it_is_touched(skin):
    people = [Person.draw(key) for key in jax.random.split(jax.random.key(1), 2)]
    stream = simulate_gesture_stream(jax.random.key(3), skin, SHEET, people, 3)
    assert stream.voltages.shape == (len(stream.seconds), 48)
    assert len(stream.gesture) == len(stream.person) == len(stream.onset) == len(stream.offset) == 3
    np.testing.assert_allclose(np.diff(stream.seconds), 1 / RATE)
    assert stream.onset[0] >= 2.0
    assert (stream.onset[1:] - stream.offset[:-1] >= 1.0).all()
    size = np.abs(stream.voltages - stream.voltages[:60].mean(axis=0)).max(axis=1)
    untouched = size[stream.seconds < stream.onset[0] - 2 / RATE]
    for start, end in zip(stream.onset, stream.offset, strict=True):
        assert size[(stream.seconds >= start) & (stream.seconds <= end)].max() > 2 * untouched.max()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key": 0}, "key must be one random key"),
        ({"skin": None}, "skin must be"),
        ({"people": []}, "people: give one"),
        ({"number": 0}, "number must be"),
        ({"pause": -1.0}, "pause must be"),
    ],
)
def test_bad_arguments(skin, change, message):
    given = {"key": KEY, "skin": skin, "people": [Person.draw(KEY)], "number": 2, "pause": 1.0} | change
    with pytest.raises(ValueError, match=message):
        simulate_gesture_stream(
            given["key"], given["skin"], SHEET, given["people"], given["number"], pause=given["pause"]
        )
