"""The folder that results are written to, all of them or none."""

from __future__ import annotations

import csv
import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jeit.files import whole_files

# Names of files may hold what is no letter in any script.
_UNSAID = "backslashreplace"


@contextmanager
def results(folder: str | Path, names: tuple[str, ...]) -> Iterator[Path]:
    """A folder to write files of these `names` to; in `folder`, made if need be, they take their places together, once
    all are written. Raises `ValueError` if it cannot be one."""
    with whole_files(results_folder(folder, names)) as beside:
        yield beside


def write_json(report: dict[str, Any], path: Path) -> None:
    """Write a report of plain numbers, strings, lists and dictionaries."""
    text = json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", "utf-8", errors=_UNSAID)


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table (CSV) under the names of its columns."""
    with path.open("w", newline="", encoding="utf-8", errors=_UNSAID) as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(rows)


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
