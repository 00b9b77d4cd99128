"""Lengths, which are in metres."""

from __future__ import annotations

from typing import Any

import numpy as np

from jeit.arguments.kinds import is_number, told

IN_MILLIMETRES = "were millimetres given for metres?"
"""What is asked where a length is larger than it can be."""


def check_metres(name: str, value: Any, most: float = np.inf, limit: str = "") -> None:
    """Raise `ValueError`, about the argument `name`, for what is no positive length in metres, and for one of more than
    `most` metres; `limit` says in words what is so long."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be a positive length in metres; it is {told(value)}.")
    if value > most:
        raise ValueError(f"{name} is {1e3 * float(value):g} mm, more than {limit}, {1e3 * most:g} mm; {IN_MILLIMETRES}")
