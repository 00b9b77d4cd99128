"""Recorded frames: units, rows and columns, times, reference frames, and files that are refused."""

import numpy as np
import pytest

from jeit.data import read_frame_recording
from jeit.data.description import parse_description

FRAMES = np.arange(20.0).reshape(5, 4) + 1


def described(**data):
    return parse_description(
        {"protocol": {"kind": "adjacent", "number": 4, "current": 1e-3}, "data": data}, "skin.toml"
    )


def test_an_npz_has_times_and_a_reference(tmp_path):
    path = tmp_path / "stream.npz"
    np.savez(path, frames=FRAMES, time=np.arange(5) / 10, reference=np.ones(4))
    found = read_frame_recording(path, described(unit="mV"))
    np.testing.assert_allclose(found.frames, 1e-3 * FRAMES)
    np.testing.assert_allclose(found.reference, 1e-3 * np.ones((1, 4)))
    np.testing.assert_array_equal(found.seconds, np.arange(5) / 10)
    np.savez(path, voltages=FRAMES, seconds=np.arange(5))
    assert read_frame_recording(path).frames.shape == (5, 4)


def test_a_transposed_table_is_accepted(tmp_path):
    path = tmp_path / "stream.csv"
    np.savetxt(path, FRAMES.T, delimiter=";", header="a; b; c")
    names = ["reference", "one", "two", "three", "four"]
    found = read_frame_recording(path, described(frames_in="columns", delimiter=";", frame_names=names))
    np.testing.assert_array_equal(found.frames, FRAMES[1:])
    np.testing.assert_array_equal(found.reference, FRAMES[:1])
    assert found.seconds is None


def test_any_number_of_channels_without_a_description(tmp_path):
    np.save(tmp_path / "counts.npy", (100 * FRAMES).astype(np.int16))
    found = read_frame_recording(tmp_path / "counts.npy")
    np.testing.assert_array_equal(found.frames, 100 * FRAMES)
    assert found.frames.dtype == float


def test_part_of_complex_voltages(tmp_path):
    np.save(tmp_path / "complex.npy", FRAMES + 2j)
    for component, value in (("real", FRAMES), ("imaginary", np.full((5, 4), 2.0))):
        found = read_frame_recording(tmp_path / "complex.npy", described(component=component))
        np.testing.assert_array_equal(found.frames, value)
    with pytest.raises(ValueError, match="choose a part"):
        read_frame_recording(tmp_path / "complex.npy", described(component="complex"))


def test_values_that_are_not_finite_are_missing(tmp_path):
    (tmp_path / "holes.csv").write_text("1,nan,3,4\n1,2,inf,4\n", "utf-8")
    found = read_frame_recording(tmp_path / "holes.csv")
    np.testing.assert_array_equal(np.isnan(found.frames), [[0, 1, 0, 0], [0, 0, 1, 0]])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": FRAMES}, "there is no array 'frames'; the file holds other"),
        ({"frames": FRAMES[:, :3]}, r"frames have shape \(5, 3\)"),
        ({"frames": FRAMES[None]}, "frames have shape"),
        ({"frames": FRAMES.astype(str)}, "frames are <U"),
        ({"frames": FRAMES[:0]}, "there is none"),
        ({"frames": FRAMES, "seconds": np.zeros(4)}, "give seconds for each of 5 frames"),
        ({"frames": FRAMES, "seconds": np.array([0, 1, 2, 1, 4.0])}, "seconds fall after frame 2"),
        ({"frames": FRAMES, "seconds": np.full(5, np.nan)}, "some are not finite"),
        ({"frames": FRAMES, "reference": np.ones(3)}, "reference have shape"),
        ({"frames": np.array([None])}, "plain arrays"),
    ],
)
def test_invalid_recordings_are_reported(tmp_path, arrays, message):
    np.savez(tmp_path / "stream.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        read_frame_recording(tmp_path / "stream.npz", described())


def test_missing_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_frame_recording(tmp_path / "stream.npz")
    with pytest.raises(ValueError, match="it is a folder"):
        read_frame_recording(tmp_path)
    (tmp_path / "stream.xlsx").write_text("", "utf-8")
    with pytest.raises(ValueError, match=r"give frames as \.csv"):
        read_frame_recording(tmp_path / "stream.xlsx")
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match="not a readable NPZ file"):
        read_frame_recording(tmp_path / "cut.npz")
