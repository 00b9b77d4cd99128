"""MATLAB files: equal to SciPy's reading and writing for all types, and limited in size."""

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from jeit.files import matlab

RNG = np.random.default_rng(0)
ARRAYS = {
    "double": RNG.random((3, 4)),
    "whole": np.arange(6.0).reshape(2, 3),  # stored as bytes
    "single": RNG.random((2, 2)).astype("f4"),
    "complex": RNG.random((2, 3)) + 1j,
    "cube": RNG.random((2, 3, 4)),
    "small": np.array([[7]], "u1"),
    "signed": np.array([[-3, 70000]], "i4"),
    "long": np.array([[2**60, -1]], "i8"),
    "flags": np.array([[True, False]]),
    "sparse": scipy.sparse.csc_matrix(np.diag([1.0, 0, 3])[:, :2]),
}


@pytest.mark.parametrize("options", [{"do_compression": True}, {"do_compression": False}, {"format": "4"}])
def test_equal_to_scipy(tmp_path, options):
    old = options.get("format") == "4"
    held = {name: one for name, one in ARRAYS.items() if not (old and name in ("cube", "long", "signed", "flags"))}
    others = {} if old else {"text": "abc", "cell": np.array([1, "a"], object), "record": {"a": 1.0}}
    scipy.io.savemat(tmp_path / "a.mat", held | others, **options)
    read = matlab.load(tmp_path / "a.mat", *held, *others)
    assert set(read[""]) == set(held | others) == matlab.variable_names(tmp_path / "a.mat")
    assert set(read) - {""} == set(held)
    by_scipy = scipy.io.loadmat(tmp_path / "a.mat", spmatrix=False)
    for name, one in held.items():
        expected = one.toarray() if name == "sparse" else one
        np.testing.assert_array_equal(read[name], expected)
        assert read[name].shape == expected.shape
        assert old or read[name].dtype == by_scipy[name].dtype


def test_other_variables_are_not_unpacked(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"a": np.ones((2, 2)), "b": np.zeros((3, 3))}, do_compression=True)
    whole = (tmp_path / "a.mat").read_bytes()
    (tmp_path / "a.mat").write_bytes(whole[:-8] + b"\xff" * 8)  # the zlib stream of b is invalid
    assert set(matlab.load(tmp_path / "a.mat", "a")) == {"", "a"}
    with pytest.raises(ValueError, match=r"not a readable \.mat file"):
        matlab.load(tmp_path / "a.mat", "b")


@pytest.mark.parametrize("compressed", [True, False])
def test_a_file_that_is_cut_short_is_refused_wherever_it_ends(tmp_path, compressed):
    """Within the header or the numbers of its last variable; before that, the file is whole and has one less."""
    path = tmp_path / "a.mat"
    sizes = []
    for held in ({"a": np.ones((2, 2))}, {"a": np.ones((2, 2)), "b": np.arange(9.0)}):
        scipy.io.savemat(path, held, do_compression=compressed)
        sizes.append(path.stat().st_size)
    whole = path.read_bytes()
    for size in range(sizes[0] + 8, sizes[1]):
        path.write_bytes(whole[:size])
        for read in (matlab.variable_names, matlab.shapes, lambda file: matlab.load(file, "a")):
            with pytest.raises(ValueError, match=r"^a\.mat is not a readable \.mat file; .* \(it is cut short\)\.$"):
                read(path)
    path.write_bytes(whole[: sizes[0]])
    assert matlab.variable_names(path) == {"a"}
