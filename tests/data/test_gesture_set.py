"""Sets of recorded gestures: written to files and read back, and refused if their arrays do not match."""

import numpy as np
import pytest

from jeit.data import GestureSet

ARRAYS = {
    "gesture": np.array(["tap", "slap"]),
    "person": np.array(["ann", "bob"]),
    "start": np.array([0, 2, 5]),
    "seconds": np.array([0.0, 0.1, 0.0, 0.1, 0.2]),
    "voltages": np.arange(15.0).reshape(5, 3),
    "reference": np.ones(3),
    "untouched": np.ones((4, 3)),
}


def test_round_trip(tmp_path):
    made = GestureSet(**ARRAYS)
    made.write(tmp_path / "set.npz")
    again = GestureSet.read(tmp_path / "set.npz")
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(getattr(again, name), array)
    seconds, changes = again.changes(1)
    np.testing.assert_array_equal(seconds, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(changes, ARRAYS["voltages"][2:] - 1)


def test_recordings_without_names_are_of_one_person(tmp_path):
    np.savez(tmp_path / "set.npz", **{name: array for name, array in ARRAYS.items() if name != "person"})
    assert GestureSet.read(tmp_path / "set.npz").person.tolist() == [0, 0]


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "set.npz"
    np.savez(path, gesture=np.array(["tap"]))
    with pytest.raises(ValueError, match="there is no array 'start'"):
        GestureSet.read(path)
    np.savez(path, gesture=np.array([object()]))
    with pytest.raises(ValueError, match="plain arrays"):
        GestureSet.read(path)
    path.write_text("text")
    with pytest.raises(ValueError, match="not a set of gestures"):
        GestureSet.read(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": np.array([0, 2, 4])}, "start goes from 0 to 4; give 0 first"),
        ({"voltages": np.ones(5)}, r"voltages \(F, M\)"),
        ({"gesture": np.array("tap")}, r"gesture must be \(n,\)"),
        ({"start": np.array([0, 6, 5])}, "start falls"),
        ({"start": np.array([0.0, 2.0, 5.0])}, "start is float64; give whole numbers"),
        ({"gesture": np.array([1, 2])}, "gesture is int64; give text"),
        ({"person": np.zeros(3, int)}, r"person has shape \(3,\)"),
        ({"reference": np.ones(2)}, r"reference has shape \(2,\)"),
        ({"untouched": np.ones((4, 2))}, "untouched has shape"),
        ({"seconds": np.full(5, np.nan)}, "seconds must be finite"),
        ({"voltages": np.ones((5, 3), complex)}, "voltages is complex128; give real numbers"),
    ],
)
def test_arrays_that_do_not_match_are_reported(change, message):
    with pytest.raises(ValueError, match=message):
        GestureSet(**(ARRAYS | change))
