"""Things of another kind than is asked for."""

from typing import Any

import jax
import numpy as np

# Of numbers, texts and nothing it is told what they are, with so many letters at most; of all else, of what kind.
_PLAIN, _LONGEST = (str, bytes, int, float, complex, type(None)), 60


def check_kind(name: str, given: Any, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no `kind`; `wanted` says what is, with an example."""
    if not isinstance(given, kind):
        raise ValueError(f"{name} must be {wanted}; it is {told(given)}.")


def told(given: Any) -> str:
    """What was given, in a few words: 'laplace', nan, a list, an array of float64 of shape (3,)."""
    if isinstance(given, (np.generic, np.ndarray, jax.Array)):
        if given.shape == () and getattr(given.dtype, "kind", "key") in "biufc":
            return repr(np.asarray(given).item())
        return f"an array of {given.dtype} of shape {given.shape}"
    if isinstance(given, _PLAIN):
        text = repr(given)
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
    if isinstance(given, type):
        return f"the class {given.__name__} itself"
    name = type(given).__name__
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"
