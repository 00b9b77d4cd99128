"""A long simulated recording of gestures: where loads are is where the skin changes, and nowhere else."""

import jax
import numpy as np
import pytest
from gesture_skin import RATE, SHEET, gestures_and_stream

from jeit.simulate import Person, simulate_gesture_stream


def test_the_skin_changes_where_it_is_touched():
    _, stream = gestures_and_stream()
    assert stream.voltages.shape == (len(stream.seconds), 48)
    assert len(stream.gesture) == len(stream.person) == len(stream.onset) == len(stream.offset) == 6
    np.testing.assert_allclose(np.diff(stream.seconds), 1 / RATE)
    assert stream.onset[0] >= 2.0
    assert (stream.onset[1:] - stream.offset[:-1] >= 1.0).all()
    size = np.abs(stream.voltages - stream.voltages[:60].mean(axis=0)).max(axis=1)
    untouched = size[stream.seconds < stream.onset[0] - 2 / RATE]
    for start, end in zip(stream.onset, stream.offset, strict=True):
        assert size[(stream.seconds >= start) & (stream.seconds <= end)].max() > 2 * untouched.max()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"key": 0}, "key must be one random key"),
        ({"skin": None}, "skin must be"),
        ({"people": []}, "people: give one"),
        ({"number": 0}, "number must be"),
        ({"pause": -1.0}, "pause must be"),
    ],
)
def test_what_cannot_be_is_said(change, said):
    key = jax.random.key(0)
    given = {"key": key, "skin": None, "people": [Person.draw(key)], "number": 2, "pause": 1.0} | change
    if "skin" not in change:
        from jeit.electrodes import PointElectrodes
        from jeit.forward import ForwardModel
        from jeit.protocol import adjacent
        from jeit.simulate import PressedSkin, material

        places = [[0.1, 0.0], [0.0, 0.05], [-0.1, 0.0], [0.0, -0.05]]
        model = ForwardModel(SHEET.mesh(num_points=60), PointElectrodes(np.array(places)), adjacent(4))
        given["skin"] = PressedSkin(key, model, material("conductive fabric"))
    with pytest.raises(ValueError, match=said):
        simulate_gesture_stream(
            given["key"], given["skin"], SHEET, given["people"], given["number"], pause=given["pause"]
        )
