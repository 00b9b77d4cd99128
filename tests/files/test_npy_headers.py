"""NPY files whose header is inconsistent are refused, with the reason."""

import numpy as np
import pytest

from jeit.files import npy_array


def written(path, version, header):
    """Write an NPY file of this format and header, without data."""
    text = (header + "\n").encode()
    size = len(text).to_bytes(2 if version == (1, 0) else 4, "little")
    path.write_bytes(np.lib.format.magic(*version) + size + text)
    return path


def described(shape, kind="<f8"):
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"


@pytest.mark.parametrize(
    ("version", "header", "reason"),
    [
        ((1, 0), described("(-1,)"), r"shape \(-1,\)"),
        ((1, 0), described("(4294967296, 4294967296)"), "shape"),
        ((2, 0), described("(2,)", "|O"), "objects"),
    ],
)
def test_headers_are_refused(tmp_path, version, header, reason):
    with pytest.raises(ValueError, match=rf"^not a readable NPY file.*{reason}"):
        npy_array(written(tmp_path / "a.npy", version, header))
