"""MATLAB files, with errors that a person can act on."""

from pathlib import Path

import numpy as np
import scipy.io


def variable_names(path: Path) -> set[str]:
    """Names of the variables in a .mat file. Raises `ValueError` when it is not a readable .mat file."""
    return {name for name, _, _ in _guard(path, scipy.io.whosmat)}


def load(path: Path) -> dict[str, np.ndarray]:
    """The variables of a .mat file, sparse matrices made dense.

    Raises `ValueError` when it cannot be read.
    """
    content = _guard(path, scipy.io.loadmat)
    return {
        name: value.toarray() if hasattr(value, "toarray") else value
        for name, value in content.items()
        if not name.startswith("__")
    }


def numbers(content: dict[str, np.ndarray], key: str, path: Path) -> np.ndarray:
    """The numeric variable `key`. Raises `ValueError` when it is missing or not numeric."""
    if key not in content:
        known = ", ".join(sorted(content))
        raise ValueError(f"{path.name}: there is no variable '{key}'; the file has {known}.")
    value = np.asarray(content[key])
    if value.dtype.kind not in "fiuc" or value.size == 0:
        raise ValueError(f"{path.name}: variable '{key}' holds {value.dtype} of shape {value.shape}, not numbers.")
    return value


def _guard(path: Path, reader):
    try:
        return reader(str(path))
    except NotImplementedError:
        raise ValueError(
            f"{path.name} was saved in MATLAB's version 7.3 (HDF5). Save it again with `save(name, '-v7')`."
        ) from None
    except OSError as error:
        if error.errno is not None:
            raise
        raise ValueError(f"{path.name} is not a readable .mat file ({error}). Is it complete?") from None
    except Exception as error:  # scipy raises many kinds on damaged files
        raise ValueError(f"{path.name} is not a readable .mat file ({error}). Is it complete?") from None
