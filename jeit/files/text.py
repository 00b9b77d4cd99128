"""Text files, TOML and JSON: read within limits, with errors that name the file."""

from __future__ import annotations

import json
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jeit.files.limits import check_memory

_LONGEST_REASON = 120


@contextmanager
def read_as(said: str) -> Iterator[None]:
    """Context for reading by other packages: whatever they raise becomes a `ValueError`, `said` (such as "not a
    readable WAV file") with their reason in brackets; errors that there is no such file, or that it may not be read,
    are passed on.

    Warnings of the packages are not shown: a file that can be read is as it should be.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except Exception as error:  # of any kind: packages that read formats raise what they stumble over
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            raise
        raise ValueError(f"{said} ({reason(error)}).") from None


def reason(error: Exception) -> str:
    """Message of an error, in one short line: its type where it has no message."""
    text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return text if len(text) <= _LONGEST_REASON else f"{text[: _LONGEST_REASON - 1]}…"


# Bytes of a file that a person writes, at most; bytes of memory for each of a text's.
_LONGEST, _TEXT = 2**22, 4
# Parts of a key.
_DEEPEST = 32


def read_text(path: str | Path, *, encoding: str = "utf-8", most: int | None = None) -> str:
    """The text of a file of at most `most` bytes, or of what may be in memory (`check_memory`).

    Raises `ValueError`, with the file's name, for larger ones, `UnicodeError`, which is one too, for what is no text,
    and `OSError` where there is none.
    """
    path = Path(path)
    check_size(path, most)
    content = path.read_bytes()
    try:
        return content.decode(encoding)
    except UnicodeDecodeError:
        raise UnicodeError(f"{path.name} is no text in UTF-8.") from None


def check_size(path: Path, most: int | None = None) -> None:
    """Raise `ValueError` for a file of more than `most` bytes, or of more than may be in memory (`check_memory`)."""
    size = path.stat().st_size
    if most is not None and size > most:
        raise ValueError(f"{path.name} has {size} bytes, and a file of its kind {most} at most: is it the right one?")
    check_memory(path.name, _TEXT * size)


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file that a person wrote. Raises `ValueError`, with its name and line, for what is none, and
    `OSError` where there is no such file."""
    return parsed_toml(read_text(path, most=_LONGEST), Path(path).name)


def parsed_toml(text: str, name: str) -> dict[str, Any]:
    """The same of a `text` from the file `name`. Raises `ValueError` for what is none."""
    if any(_dots(line) > _DEEPEST for line in text.splitlines()):
        raise ValueError(f"{name} has a key of more than {_DEEPEST} parts; none is of so many.")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"{name} is nested too deep.") from None
    except ValueError as error:  # TOMLDecodeError, and numbers of too many digits
        raise ValueError(f"{name} is no TOML file: {reason(error)}.") from None


def _dots(line: str) -> int:
    """Most dots in a key of a line of TOML: such make the parser slow, with their square."""
    if "=" not in line:
        return line.count(".") if line.lstrip().startswith("[") and "," not in line else 0
    before = [part.rpartition("{")[2].rpartition(",")[2] for part in line.split("=")[:-1]]
    return max(part.count(".") for part in before)


def read_json(path: str | Path, *, most: int = 2**26) -> Any:
    """Content of a JSON file of at most `most` bytes. Raises `ValueError`, with its name and place, for what is none,
    and `OSError` where there is no such file."""
    path = Path(path)
    try:
        return json.loads(read_text(path, most=most))
    except RecursionError:
        raise ValueError(f"{path.name} is nested too deep.") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path.name} is no JSON file: {reason(error)}.") from None
