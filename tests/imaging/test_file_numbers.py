"""Numbers of files without a description: which array holds the frames, how they are arranged, and what is refused."""

import numpy as np
import pytest
import scipy.io

from jeit.imaging.possible_protocols import FileNumbers

FRAMES = np.arange(120.0).reshape(3, 40)


def table(numbers: FileNumbers) -> np.ndarray:
    return numbers.frames([40]).table


def test_frames_are_rows_of_numpy_arrays_and_columns_of_matlab_arrays(tmp_path):
    np.save(tmp_path / "a.npy", FRAMES)
    np.savez(tmp_path / "a.npz", frames=FRAMES, rate=np.array(10.0))
    scipy.io.savemat(tmp_path / "a.mat", {"frames": FRAMES.T, "rate": 10.0})
    for name in ("a.npy", "a.npz", "a.mat"):
        numbers = FileNumbers.read(tmp_path / name, None)
        np.testing.assert_array_equal(table(numbers), FRAMES)
        assert numbers.sizes == (120, 40, 3)


def test_of_several_arrays_one_is_named_or_left_over(tmp_path):
    arrays = {"empty": FRAMES, "rod": 2 * FRAMES}
    np.savez(tmp_path / "a.npz", **arrays)
    np.testing.assert_array_equal(table(FileNumbers.read(tmp_path / "a.npz", "rod")), 2 * FRAMES)
    np.testing.assert_array_equal(table(FileNumbers.read(tmp_path / "a.npz", None, "rod")), FRAMES)
    np.savez(tmp_path / "b.npz", voltages=FRAMES, rod=2 * FRAMES)
    np.testing.assert_array_equal(table(FileNumbers.read(tmp_path / "b.npz", None)), FRAMES)
    np.testing.assert_array_equal(table(FileNumbers.read(tmp_path / "b.npz", None, "voltages")), 2 * FRAMES)
    with pytest.raises(ValueError, match=r"are empty \(3 × 40\), rod \(3 × 40\)\. Name that of the frames"):
        FileNumbers.read(tmp_path / "a.npz", None)
    with pytest.raises(ValueError, match=r"has no array 'rods'.*'rod'"):
        FileNumbers.read(tmp_path / "a.npz", "rods")


def test_a_text_file_has_no_arrays(tmp_path):
    np.savetxt(tmp_path / "a.csv", FRAMES, delimiter=",")
    np.testing.assert_array_equal(table(FileNumbers.read(tmp_path / "a.csv", None)), FRAMES)
    with pytest.raises(ValueError, match=r"a\.csv has no arrays to choose from"):
        FileNumbers.read(tmp_path / "a.csv", "frames")


def test_lines_of_openeit_are_frames(tmp_path):
    frames = np.arange(1.0, 97.0).reshape(3, 32)
    lines = [f"magnitudes: {', '.join(f'{value:.4f}' for value in frame)}" for frame in frames]
    (tmp_path / "a.txt").write_text("".join(f"{line}\n" for line in lines), "utf-8")
    numbers = FileNumbers.read(tmp_path / "a.txt", None)
    assert numbers.shape == "3 lines of 32"
    np.testing.assert_array_equal(numbers.frames([32]).table, frames)


def test_arrays_of_text_and_objects_are_no_frames(tmp_path):
    other = {"names": np.array(["a", "b", "c", "d"]), "settings": np.array([{}], dtype=object)}
    np.savez(tmp_path / "a.npz", frames=FRAMES, **other)
    np.testing.assert_array_equal(table(FileNumbers.read(tmp_path / "a.npz", None)), FRAMES)
    np.savez(tmp_path / "b.npz", **other)
    with pytest.raises(ValueError, match=r"b\.npz holds no array of numbers"):
        FileNumbers.read(tmp_path / "b.npz", None)
