"""Limits of what is read: sizes, counts and text."""

from __future__ import annotations

import json
import os
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MOST_ELECTRODES = 1024
"""Electrodes that a file may describe: the channels of a protocol grow with their square."""

_VARIABLE, _USUAL = "JEIT_FILE_GB", 1.0


class TooLarge(ValueError):
    """Raised for a file whose content would take more memory than allowed."""


def check_memory(name: str, size: float) -> None:
    """Raise `TooLarge`, a `ValueError`, where what is in the file `name` would take more than a gigabyte: `size` bytes.

    More is allowed by the environment variable JEIT_FILE_GB, in gigabytes.
    """
    most = _most()
    if size > 1e9 * most:
        raise TooLarge(
            f"{name} would take {size / 1e9:.3g} GB in memory, more than the {most:g} GB that a file may. If that is "
            f"meant, allow it by setting the environment variable {_VARIABLE}={size / 1e9 + 0.5:.0f}."
        )


def check_electrodes(name: str, number: int) -> None:
    """Raise `ValueError` where the file `name` describes more than `MOST_ELECTRODES`."""
    if number > MOST_ELECTRODES:
        raise ValueError(
            f"{name} describes {number} electrodes, more than {MOST_ELECTRODES}, whose {MOST_ELECTRODES**2 // 10**6} "
            "million channels are no longer imaged; in Python there is no such limit."
        )


def most_bytes() -> float:
    """Bytes of memory that a file may take, as the environment says. Raises `ValueError` where it says no number."""
    return 1e9 * _most()


def _most() -> float:
    """Gigabytes, as the environment says."""
    try:
        most = float(os.environ.get(_VARIABLE, _USUAL))
    except ValueError:
        most = -1.0
    if not 0 < most < float("inf"):
        raise ValueError(f"{_VARIABLE} must be a positive number of gigabytes; it is {os.environ[_VARIABLE][:40]!r}.")
    return most


KEY = 40
"""Letters of a key in a message, at most."""
# Greatest number of letters of a whole message, of faults reported in sentences, and of further faults named by their
# keys.
_LONGEST, _FAULTS, _KEYS = 390, 4, 10
ALL = "; there are "
"""What goes before all the words that there are."""


def faults_message(origin: str, sentences: list[str], keys: Sequence[str] = ()) -> str:
    """One message of several `sentences` about the file `origin`: the first, and more as far as there is room beside
    the `keys` that the others are about, of which up to ten are named."""
    first = cut(f"{cut(origin, 2 * KEY)}: {sentences[0]}", _LONGEST - 20)
    shown = 1
    for number in range(min(len(sentences), _FAULTS), 0, -1):
        # Where there is a word that is likely meant, the list of all has to make room first.
        rest = [f"{one.split(ALL)[0]}." if "?)" + ALL in one else one for one in sentences[1:number]]
        for others in (sentences[1:number], rest):
            message = " ".join([first, *others, *_more(keys[number:], len(sentences) - number, _KEYS)])
            if len(message) <= _LONGEST:
                return message
    while len(" ".join([first, *_more(keys[1:], len(sentences) - 1, shown)])) <= _LONGEST and shown < _KEYS:
        shown += 1
    return " ".join([first, *_more(keys[1:], len(sentences) - 1, shown - 1)])


def _more(keys: Sequence[str], number: int, most: int) -> list[str]:
    """Text about a `number` of faults that there is no room for, of which at most so many are named by key."""
    named = keys[:most]
    said = [f"Wrong too: {', '.join(named)}."] if named else []
    return [*said, f"And {number - len(named)} more."] if number > len(named) else said


def cut(text: str, most: int) -> str:
    """A text of so many letters, its end left out where it is longer."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


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
_MOST_WRITTEN, _TEXT = 2**22, 4
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
    return parsed_toml(read_text(path, most=_MOST_WRITTEN), Path(path).name)


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
