"""The folder that results are written to."""

import tempfile
from pathlib import Path


def results_folder(folder: str | Path, names: tuple[str, ...]) -> Path:
    """The folder for files of these `names`, made if need be. Raises `ValueError` if it cannot be one."""
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise ValueError(f"folder {path} is a file; give a folder for the results.")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
        taken = [name for name in names if (path / name).is_dir()]
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"folder {path} cannot be written to ({reason}); give another folder.") from None
    if taken:
        raise ValueError(f"folder {path}: there is a folder named {taken[0]} in it; give another.")
    return path
