"""Limits of the memory and the electrodes that a file may ask for, and errors of files that exceed them."""

from __future__ import annotations

import os
from collections.abc import Sequence

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
