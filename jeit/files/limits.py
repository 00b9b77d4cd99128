"""How much a file may ask for before anything is made of it."""

from __future__ import annotations

import os

MOST_ELECTRODES = 1024
"""Electrodes that a file may describe: the channels of a protocol grow with their square."""

_VARIABLE, _USUAL = "JEIT_FILE_GB", 1.0


class TooLarge(ValueError):
    """What is in a file would take more memory than a file may."""


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
