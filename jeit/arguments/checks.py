"""Checks of arguments, and helpers that word messages and what consoles and notebooks show of objects."""

from __future__ import annotations

import difflib
import importlib
import math
from collections.abc import Callable, Iterable
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeit_solvers.engines import has_values

# Types whose values are shown in messages, and maximum number of characters of a value; for other types, the name of
# the type is shown.
_PLAIN, _LONGEST = (str, bytes, int, float, complex, type(None)), 60


def check_kind(name: str, given: Any, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raise `ValueError` with the argument's `name` unless `given` is an instance of `kind`; `wanted` describes what is
    expected, with an example."""
    if not isinstance(given, kind):
        raise ValueError(f"{name} must be {wanted}; it is {describe(given)}.")


def is_number(given: Any) -> bool:
    """Whether the argument is one finite real number; a zero-dimensional array counts as a number, a boolean does
    not."""
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
            # An integer with more digits than Python converts to text.
            return "a number without end"
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
    if isinstance(thing, type):
        return f"the class {thing.__name__} itself"
    name = type(thing).__name__
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def _scalar(given: Any) -> Any:
    """Convert a zero-dimensional array to a Python scalar; everything else, including random keys, is returned
    unchanged."""
    if isinstance(given, (np.generic, np.ndarray, jax.Array)) and given.shape == () and hasattr(given.dtype, "kind"):
        return np.asarray(given).item()
    return given


def real_array(name: str, given: Any, wanted: str) -> np.ndarray:
    """Convert an argument to a float64 array. Raises `ValueError` with the argument's `name` for rows of different
    lengths and for anything but real numbers; `wanted` describes what is expected."""
    try:
        values = np.asarray(given)
    except (ValueError, TypeError):
        raise ValueError(f"{name} must be {wanted}; it is {describe(given)}, which is no array.") from None
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be {wanted}, real numbers; it is {describe(values)}.")
    return values.astype(float)


# Percentage below which the value is not stated exactly.
_LEAST_PERCENT = 0.001


def counted(number: int, noun: str) -> str:
    """A number with its noun: "1 frame", "1,000 frames", "2 touches"."""
    several = "es" if noun.endswith(("ch", "s", "x")) else "s"
    return f"{number:,} {noun}{'' if number == 1 else several}"


def percent(value: float | None) -> str:
    """A ratio in per cent with two significant digits, all digits before the decimal point, and no exponent."""
    if value is None:
        return "not known"
    share = 100 * float(value)
    if not math.isfinite(share) or abs(share) >= 99.5:
        return f"{share:.0f} %"
    if 0 < abs(share) < _LEAST_PERCENT:
        return f"less than {_LEAST_PERCENT:g} %"
    return f"{share:.2g} %"


def signed_percent(change: float) -> str:
    """A relative change in per cent, with its sign and two significant digits."""
    return f"{float(f'{100 * change:.2g}'):+g} %"


Interval = tuple[float | None, float | None]
"""Ends of a credible interval, None where the data leave an end open."""


def interval_text(interval: Interval, written: Callable[[float], str]) -> str:
    """An interval as text, each end as `written`. Where one end is open, "at least" or "at most" the known end, or
    "beyond" it if it is a decrease, of which "at most -90 %" might mean a smaller one."""
    low, high = interval
    if low is None:
        return "not determined" if high is None else f"{'beyond' if high < 0 else 'at most'} {written(high)}"
    return f"at least {written(low)}" if high is None else f"{written(low)} to {written(high)}"


# Maximum reading of any instrument, in volts or fractions of volts; squares of such numbers do not overflow.
_MOST = 1e12


def readings(values: np.ndarray) -> np.ndarray:
    """Replace values that are not readings by NaN: infinite values, and values beyond any instrument (1e12)."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(np.abs(values) <= _MOST, values, np.nan)


def check_key(key: Any, name: str = "key") -> None:
    """Raise `ValueError` with the argument's `name` unless `key` is a single JAX random key, of either the new or the
    old type."""
    if isinstance(key, (jax.Array, np.ndarray)):
        new = jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
        if new or (key.dtype == np.uint32 and key.ndim == 1):
            return
    seed = key if isinstance(key, int) and not isinstance(key, bool) else 0
    raise ValueError(f"{name} must be one random key, such as jax.random.key({seed}); it is {describe(key)}.")


IN_MILLIMETRES = "were millimetres given for metres?"
"""Question to append to a message about a length that is larger than possible."""


def check_metres(name: str, value: Any, most: float = np.inf, limit: str = "") -> None:
    """Raise `ValueError` with the argument's `name` unless `value` is a positive length in metres of at most `most`;
    `limit` describes that maximum in words."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be a positive length in metres; it is {describe(value)}.")
    if value > most:
        raise ValueError(f"{name} is {1e3 * float(value):g} mm, more than {limit}, {1e3 * most:g} mm; {IN_MILLIMETRES}")


def check_positive(name: str, value: float) -> None:
    """Raises `ValueError` if `value` is not a finite number greater than zero."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be a positive number in SI units; it is {describe(value)}.")


def check_not_negative(name: str, value: float) -> None:
    """Raises `ValueError` if `value` is not a finite number greater than or equal to zero."""
    if not (is_number(value) and value >= 0):
        raise ValueError(f"{name} must be zero or positive; it is {describe(value)}.")


def check_name(argument: str, given: Any, names: Iterable[str], otherwise: str = "") -> None:
    """Raise `ValueError` with the `argument` unless `given` is one of `names`; `otherwise` describes what else is
    accepted."""
    known = list(names)
    if not (isinstance(given, str) and given in known):
        said = f"it is {describe(given)}{did_you_mean(given, known)}"
        raise ValueError(f"{argument} must be one of {', '.join(known)}{otherwise}; {said}.")


def did_you_mean(given: Any, names: Iterable[str]) -> str:
    """Question, in brackets, that proposes the name most similar to the given one or beginning with it; empty if none
    is."""
    known, word = list(names), given.lower() if isinstance(given, str) else ""
    begun = [name for name in known if word and name.startswith(word)]
    close = difflib.get_close_matches(word, known, n=1) or begun
    return f" (did you mean {close[0]!r}?)" if close else ""


def listed(names: Iterable[Any], most: int = 8) -> str:
    """List the first names, such as those in a file, in one short line, with the number of remaining names."""
    known = [str(name) for name in names]
    shown = [name if len(name) <= 24 else f"{name[:23]}…" for name in known[:most]]
    more = f" and {len(known) - most} more" if len(known) > most else ""
    return (", ".join(shown) or "nothing") + more


def check_has_values(name: str, given: Any, use: str, instead: str) -> None:
    """Raise `ValueError` with the argument's `name` for a pytree that contains values traced by `jax.jit`, `jax.vmap`
    or a derivative; `use` says what the values are needed for, `instead` what to give or do."""
    if not has_values(given):
        raise ValueError(
            f"{name} is traced, inside jax.jit, jax.vmap or a derivative, and {use} its values: {instead}."
        )


def brief(described: Callable[[], str], one: Any) -> str:
    """The text of an object from `described`, or its class alone where it cannot be described: JAX puts other things
    in place of arrays for a while."""
    try:
        return described()
    except Exception:
        return f"<{type(one).__name__}>"


def picture(one: Any) -> bytes | None:
    """PNG of an object for a notebook (`_repr_png_`), or None if it has none, such as a traced one.

    The report that draws it is imported by its name, for the objects are of lower layers.
    """
    return importlib.import_module("jeit.report.notebook").picture(one)


def page(one: Any) -> str | None:
    """HTML of an object for a notebook (`_repr_html_`): its text, and its picture; or None if it has none."""
    return importlib.import_module("jeit.report.notebook").page(one)
