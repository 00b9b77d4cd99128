"""The arrays of an NPZ file that hold what is asked for."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

_FAULTS = (ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError)


def npz_arrays(path: str | Path, names: tuple[str, ...], needed: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The arrays of these `names`, as far as the file has them.

    Raises `FileNotFoundError`, and `ValueError` for a folder, another kind of file, a broken one, arrays of objects,
    and where one that is `needed` is missing.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"'{path}' is a folder; give an NPZ file.")
    if not path.is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    try:
        with path.open("rb") as file:
            if file.read(4) != b"PK\x03\x04":
                raise ValueError("it does not begin as one")
            file.seek(0)
            with np.load(file, allow_pickle=False) as content:
                arrays = {name: content[name] for name in names if name in content.files}
                held = ", ".join(content.files[:12]) or "nothing"
        odd = [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]
        if odd:
            raise ValueError(f"'{odd[0]}' in it is a file of another kind")
    except _FAULTS as error:
        said = " ".join(str(error).split())
        hint = " Arrays of objects, such as labels of mixed kinds, are not read." if "pickle" in said else ""
        raise ValueError(
            f"'{path}' is not a readable NPZ file of plain arrays ({said}); write it with numpy.savez.{hint}"
        ) from None
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise ValueError(f"'{path}': there is no array '{missing[0]}'; the file holds {held}.")
    return arrays
