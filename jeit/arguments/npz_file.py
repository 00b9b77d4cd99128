"""The arrays of an NPZ file that are asked for: plain numbers and text, nothing that would be executed."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

# What NumPy, and zipfile beneath it, say of files that are broken, encrypted, or compressed in ways they do not know.
_FAULTS = (ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError)


def npz_arrays(path: Path, *keys: str, otherwise: str = "not an NPZ file") -> dict[str, np.ndarray]:
    """The arrays named, as far as an NPZ file has them, and under "" the names of all that it holds.

    Raises `ValueError` for other files (`otherwise` says which), broken ones, and arrays of objects; `OSError` where
    there is no such file.
    """
    arrays: dict[str, np.ndarray] = {}
    with path.open("rb") as file:
        start = file.read(4)
        if start == b"\x93NUM":
            raise ValueError(
                "it holds a single array without names; save it with numpy.savez and the names of its arrays."
            )
        if start != b"PK\x03\x04":
            raise ValueError(f"{otherwise}; save the arrays with numpy.savez.")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as content:
                for key in keys:
                    if key in content.files:
                        arrays[key] = content[key]
                        if not isinstance(arrays[key], np.ndarray):
                            raise ValueError(f"'{key}' in it is a file of another kind")
                arrays[""] = np.array(content.files)
        except _FAULTS as error:
            message = " ".join(str(error).split())
            hint = " as numbers and text, not objects" if "pickle" in message or "Object" in message else ""
            raise ValueError(f"not a readable NPZ file of plain arrays ({message}); write it again{hint}.") from None
    return arrays


def need(arrays: dict[str, np.ndarray], *keys: str) -> None:
    """Raise `ValueError` where an array is missing, with the names of those that are there."""
    missing = [key for key in keys if key not in arrays]
    if missing:
        held = ", ".join(str(name) for name in arrays[""][:12]) or "nothing"
        raise ValueError(f"there is no array '{missing[0]}'; the file holds {held}.")
