"""Checks of arguments, and the words of their messages."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeit_solvers.engines import has_values

# Types whose values are shown in messages, with at most this many letters; of all others the type is named.
_PLAIN, _LONGEST = (str, bytes, int, float, complex, type(None)), 60


def check_kind(name: str, given: Any, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise `ValueError`, about the argument `name`, for what is no `kind`; `wanted` says what is, with an example."""
    if not isinstance(given, kind):
        raise ValueError(f"{name} must be {wanted}; it is {describe(given)}.")


def is_number(given: Any) -> bool:
    """Whether it is one real number, and finite; an array of no dimensions is one, a truth value is not."""
    number = _scalar(given)
    return isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)


def describe(given: Any) -> str:
    """Describe an argument in a few words: 'laplace', nan, a list, an array of float64 of shape (3,)."""
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


def real_array(name: str, given: Any, wanted: str) -> np.ndarray:
    """Convert an argument to an array of float64. Raises `ValueError`, about the argument `name`, for what holds no
    real numbers, or rows of several lengths; `wanted` says what is."""
    try:
        values = np.asarray(given)
    except (ValueError, TypeError):
        raise ValueError(f"{name} must be {wanted}; it is {describe(given)}, which is no array.") from None
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be {wanted}, real numbers; it is {describe(values)}.")
    return values.astype(float)


# Below this, the exact value does not matter.
_LEAST_PERCENT = 0.001


def counted(number: int, noun: str) -> str:
    """A number with its noun: "1 frame", "1,000 frames", "2 touches"."""
    several = "es" if noun.endswith(("ch", "s", "x")) else "s"
    return f"{number:,} {noun}{'' if number == 1 else several}"


def percent(value: float | None) -> str:
    """A ratio in per cent with two digits, all of those before the point, and never an exponent."""
    if value is None:
        return "not known"
    share = 100 * float(value)
    if not math.isfinite(share) or abs(share) >= 99.5:
        return f"{share:.0f} %"
    if 0 < abs(share) < _LEAST_PERCENT:
        return f"less than {_LEAST_PERCENT:g} %"
    return f"{share:.2g} %"


# No instrument reads more, in volts or any part of them; the squares of such numbers are still of use.
_MOST = 1e12


def readings(values: np.ndarray) -> np.ndarray:
    """Values with NaN where there is no reading: where they are NaN, infinite, or beyond any instrument (1e12)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(np.abs(values) <= _MOST, values, np.nan)


def check_key(key: Any, name: str = "key") -> None:
    """Raise `ValueError`, about the argument `name`, for what is no single key of JAX, of the new kind or the old."""
    if isinstance(key, (jax.Array, np.ndarray)):
        new = jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
        if new or (key.dtype == np.uint32 and key.ndim == 1):
            return
    seed = key if isinstance(key, int) and not isinstance(key, bool) else 0
    raise ValueError(f"{name} must be one random key, such as jax.random.key({seed}); it is {describe(key)}.")


IN_MILLIMETRES = "were millimetres given for metres?"
"""What is asked where a length is larger than it can be."""


def check_metres(name: str, value: Any, most: float = np.inf, limit: str = "") -> None:
    """Raise `ValueError`, about the argument `name`, for what is no positive length in metres, and for one of more than
    `most` metres; `limit` says in words what is so long."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be a positive length in metres; it is {describe(value)}.")
    if value > most:
        raise ValueError(f"{name} is {1e3 * float(value):g} mm, more than {limit}, {1e3 * most:g} mm; {IN_MILLIMETRES}")


def check_name(argument: str, given: Any, names: Iterable[str], otherwise: str = "") -> None:
    """Raise `ValueError`, about `argument`, for what is none of `names`; `otherwise` says what else could be given."""
    known = list(names)
    if not (isinstance(given, str) and given in known):
        said = f"it is {describe(given)}{did_you_mean(given, known)}"
        raise ValueError(f"{argument} must be one of {', '.join(known)}{otherwise}; {said}.")


def did_you_mean(given: Any, names: Iterable[str]) -> str:
    """The name nearest to what was given, or that begins so, as a question in brackets; nothing where none is near."""
    known, word = list(names), given.lower() if isinstance(given, str) else ""
    begun = [name for name in known if word and name.startswith(word)]
    close = difflib.get_close_matches(word, known, n=1) or begun
    return f" (did you mean {close[0]!r}?)" if close else ""


def listed(names: Iterable[Any], most: int = 8) -> str:
    """The first names, such as are in a file, in one short line, and how many more there are."""
    known = [str(name) for name in names]
    shown = [name if len(name) <= 24 else f"{name[:23]}…" for name in known[:most]]
    more = f" and {len(known) - most} more" if len(known) > most else ""
    return (", ".join(shown) or "nothing") + more


def check_has_values(name: str, given: Any, use: str, instead: str) -> None:
    """Raise `ValueError`, about the argument `name`, for a pytree in which anything is traced by `jax.jit`, `jax.vmap`
    or a derivative; `use` says what its values are needed for, `instead` what to give or do."""
    if not has_values(given):
        raise ValueError(
            f"{name} is traced, inside jax.jit, jax.vmap or a derivative, and {use} its values: {instead}."
        )
