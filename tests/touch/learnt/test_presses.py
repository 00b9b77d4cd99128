"""Recorded presses: files that are read, and bad ones that are refused."""

import pickle

import numpy as np
import pytest
from made_skins import record

from jeit.touch import Presses, read_frames, read_presses

GOOD = {key: value for key, value in record(24).items() if key != "force"}
NUMBER = 24


def write(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_a_file_is_read(tmp_path):
    label = np.array(["a", "b"] * 12)
    path = write(tmp_path / "p.npz", **GOOD, label=label, time=np.arange(24.0), group=np.repeat([1, 2], 12), other=1)
    presses = read_presses(path)
    np.testing.assert_array_equal(presses.frames, GOOD["frames"])
    np.testing.assert_array_equal(presses.label, label)
    assert presses.name == "p.npz"
    assert presses.rows(slice(3, 9)).positions.shape == (6, 2)


def test_one_reference_serves_all_frames():
    presses = Presses.create(GOOD["frames"], reference=GOOD["reference"][0], positions=GOOD["positions"])
    np.testing.assert_array_equal(presses.reference, np.broadcast_to(GOOD["reference"][0], GOOD["frames"].shape))


def test_labels_are_text_and_no_touch_has_one_name():
    label = ["None", "no touch"] * 2 + ["7"] * 10 + ["8"] * 10
    assert sorted(set(Presses.create(GOOD["frames"], label=label).label)) == ["7", "8", "none"]
    assert Presses.create(GOOD["frames"], label=np.repeat([3, 4], 12)).label[0] == "3"


def test_infinite_readings_are_missing():
    frames = GOOD["frames"].copy()
    frames[3, 4] = np.inf
    assert np.isnan(Presses.create(frames, positions=GOOD["positions"]).frames[3, 4])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": 1e3 * GOOD["positions"]}, "are these metres"),
        ({"positions": GOOD["positions"][:20]}, "positions has 20 rows and frames 24"),
        ({"positions": GOOD["positions"][:, :1]}, r"positions is float64 of shape \(24, 1\)"),
        ({"positions": GOOD["positions"].astype(object)}, "positions is object of shape"),
        ({"positions": np.where(np.arange(2) == 1, np.nan, GOOD["positions"])}, "positions: row 0"),
        ({"positions": np.ones((24, 2))}, "all the same"),
        ({"positions": None}, "nothing to learn"),
        (
            {"frames": GOOD["frames"][:2], "reference": None, "positions": GOOD["positions"][:2]},
            "2 presses are too few",
        ),
        ({"frames": GOOD["frames"][0]}, "give real numbers"),
        ({"frames": GOOD["frames"].astype(str)}, "give real numbers"),
        ({"reference": GOOD["reference"][:, :5]}, "reference is float64 of shape"),
        ({"force": np.zeros(24)}, "force is the same"),
        ({"force": np.linspace(0, 1e5, 24)}, "are these newtons"),
        ({"force": np.full(24, np.nan)}, "force must be finite"),
        ({"label": ["a"] * 24}, "all presses are 'a'"),
        ({"label": ["a"] * 21 + ["b"] * 3}, "'b' has 3 of the presses"),
        ({"label": ["a"] * 23 + [""]}, "some are empty"),
        ({"label": np.array(["a"] * 12 + [1] * 12, object)}, "label mixes int and str"),
        ({"label": np.linspace(0, 1, 24)}, "label is float64"),
        ({"touched": np.ones((24, 2))}, "key 0 is the same"),
        ({"touched": np.arange(24)[:, None] == 5}, "key 0 differs in 1 of the presses only"),
        ({"touched": np.full((24, 2), 0.5)}, "true where a key was pressed"),
        ({"time": np.full(24, np.nan)}, "time must be finite"),
        ({"group": np.ones((24, 3))}, "one plain value for each press"),
    ],
)
def test_bad_presses_are_refused(change, message):
    given = {**GOOD, **change}
    with pytest.raises(ValueError, match=message):
        Presses.create(given.pop("frames"), **given)


def test_files_of_other_kinds_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_presses(tmp_path / "none.npz")
    with pytest.raises(ValueError, match="is a folder"):
        read_presses(tmp_path)
    (tmp_path / "text.npz").write_text("frames")
    with pytest.raises(ValueError, match="not an NPZ file; save the arrays"):
        read_presses(tmp_path / "text.npz")
    with pytest.raises(ValueError, match="there is no array 'frames'; the file holds positions"):
        read_presses(write(tmp_path / "less.npz", positions=GOOD["positions"]))
    with pytest.raises(ValueError, match=r"bad\.npz': frames is"):
        read_frames(write(tmp_path / "bad.npz", frames=np.ones(3)))


class Payload:
    """A pickle that would be executed."""

    def __reduce__(self):
        return (open, ("ran", "w"))


def test_objects_in_a_file_are_not_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    label = np.empty(24, object)
    label[:] = [Payload()] * 24
    assert pickle.dumps(label)
    np.savez("bad.npz", frames=GOOD["frames"], label=label)
    with pytest.raises(ValueError, match="as numbers and text, not objects"):
        read_presses("bad.npz")
    assert not (tmp_path / "ran").exists()
