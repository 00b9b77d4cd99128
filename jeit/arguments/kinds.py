"""Things of another kind than is asked for."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any

import jax
import numpy as np

# Of numbers, texts and nothing it is told what they are, with so many letters at most; of all else, of what kind.
_PLAIN, _LONGEST = (str, bytes, int, float, complex, type(None)), 60


def check_kind(name: str, given: Any, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no `kind`; `wanted` says what is, with an example."""
    if not isinstance(given, kind):
        raise ValueError(f"{name} must be {wanted}; it is {told(given)}.")


def is_number(given: Any) -> bool:
    """Whether it is one real number, and finite; an array of no dimensions is one, a truth value is not."""
    number = _scalar(given)
    return isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)


def told(given: Any) -> str:
    """What was given, in a few words: 'laplace', nan, a list, an array of float64 of shape (3,)."""
    thing = _scalar(given)
    if isinstance(thing, (np.ndarray, jax.Array)):
        return f"an array of {thing.dtype} of shape {thing.shape}"
    if isinstance(thing, _PLAIN):
        try:
            text = repr(thing)
        except ValueError:
            # A whole number of more digits than Python writes.
            return "a number without end"
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
    if isinstance(thing, type):
        return f"the class {thing.__name__} itself"
    name = type(thing).__name__
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def _scalar(given: Any) -> Any:
    """An array of no dimensions as the number that it holds, all else as it is; random keys hold none."""
    if isinstance(given, (np.generic, np.ndarray, jax.Array)) and given.shape == () and hasattr(given.dtype, "kind"):
        return np.asarray(given).item()
    return given
