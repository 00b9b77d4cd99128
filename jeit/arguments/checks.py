"""Checks of arguments, and functions that compose error messages and the texts of objects in consoles and notebooks."""

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

# Types whose values are shown in error messages, and maximum number of characters of a shown value. For values of other
# types, only the type is shown.
_SHOWN_TYPES, _MAX_SHOWN_TEXT_LENGTH = (str, bytes, int, float, complex, type(None)), 60


def check_kind(name: str, value: Any, kind: type | tuple[type, ...], expected: str) -> None:
    """Raise `ValueError` with the argument's `name` unless `value` is an instance of `kind`; `expected` describes a
    valid value, with an example."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be {expected}; it is {describe(value)}.")


def is_number(value: Any) -> bool:
    """Whether the argument is one finite real number; a zero-dimensional array counts as a number, a boolean does
    not."""
    number = _to_scalar(value)
    return isinstance(number, Real) and not isinstance(number, bool) and math.isfinite(number)


def describe(value: Any) -> str:
    """Describe an argument in a few words: 'laplace', nan, a list, an array of float64 of shape (3,)."""
    described_value = _to_scalar(value)
    if isinstance(described_value, (np.ndarray, jax.Array)):
        return f"an array of {described_value.dtype} of shape {described_value.shape}"
    if isinstance(described_value, _SHOWN_TYPES):
        try:
            value_text = repr(described_value)
        except ValueError:
            # The integer has more digits than Python converts to text.
            return "a number without end"
        return (
            value_text if len(value_text) <= _MAX_SHOWN_TEXT_LENGTH else f"{value_text[: _MAX_SHOWN_TEXT_LENGTH - 1]}…"
        )
    if isinstance(described_value, type):
        return f"the class {described_value.__name__} itself"
    type_name = type(described_value).__name__
    return f"{'an' if type_name[0] in 'AEIOU' else 'a'} {type_name}"


def _to_scalar(value: Any) -> Any:
    """Convert a zero-dimensional array to a Python scalar; everything else, including random keys, is returned
    unchanged."""
    if isinstance(value, (np.generic, np.ndarray, jax.Array)) and value.shape == () and hasattr(value.dtype, "kind"):
        return np.asarray(value).item()
    return value


def real_array(name: str, argument: Any, expected: str) -> np.ndarray:
    """Convert an argument to a float64 array. Raises `ValueError` with the argument's `name` for rows of different
    lengths and for anything but real numbers; `expected` describes a valid value."""
    try:
        values = np.asarray(argument)
    except (ValueError, TypeError):
        raise ValueError(f"{name} must be {expected}; it is {describe(argument)}, which is no array.") from None
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be {expected}, real numbers; it is {describe(values)}.")
    return values.astype(float)


# Minimum percentage that is stated as a number; for smaller percentages, the text is "less than" this value.
_MIN_STATED_PERCENT = 0.001


def counted(number: int, noun: str) -> str:
    """Text of a number with its noun, such as "1 frame", "1,000 frames" or "2 touches"."""
    plural_ending = "es" if noun.endswith(("ch", "s", "x")) else "s"
    return f"{number:,} {noun}{'' if number == 1 else plural_ending}"


def percent(value: float | None) -> str:
    """Text of a ratio in per cent, with two significant digits and without an exponent. All digits before the decimal
    point are shown."""
    if value is None:
        return "not known"
    percentage = 100 * float(value)
    if not math.isfinite(percentage) or abs(percentage) >= 99.5:
        return f"{percentage:.0f} %"
    if 0 < abs(percentage) < _MIN_STATED_PERCENT:
        return f"less than {_MIN_STATED_PERCENT:g} %"
    return f"{percentage:.2g} %"


def signed_percent(change: float) -> str:
    """Text of a relative change in per cent, with its sign and two significant digits."""
    return f"{float(f'{100 * change:.2g}'):+g} %"


Interval = tuple[float | None, float | None]
"""Lower and upper limit of a credible interval; a limit that the data do not determine is None."""


def interval_text(interval: Interval, format_end: Callable[[float], str]) -> str:
    """Text of an interval whose limits are formatted by `format_end`. If only one limit is known, the text is "at
    least" or "at most" followed by this limit. For a negative upper limit, "beyond" replaces "at most", because "at
    most -90 %" could be read as a smaller decrease."""
    lower_limit, upper_limit = interval
    if lower_limit is None:
        if upper_limit is None:
            return "not determined"
        return f"{'beyond' if upper_limit < 0 else 'at most'} {format_end(upper_limit)}"
    if upper_limit is None:
        return f"at least {format_end(lower_limit)}"
    return f"{format_end(lower_limit)} to {format_end(upper_limit)}"


# Maximum plausible voltage reading of an instrument, in any unit; squares of such numbers do not overflow.
_MAX_PLAUSIBLE_READING = 1e12


def measurable_values(values: np.ndarray) -> np.ndarray:
    """Replace values that no instrument can measure by NaN: infinite values, and absolute values above 1e12."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(np.abs(values) <= _MAX_PLAUSIBLE_READING, values, np.nan)


def check_key(key: Any, name: str = "key") -> None:
    """Raise `ValueError` with the argument's `name` unless `key` is a single JAX random key, of the new type (from
    `jax.random.key`) or the old type (from `jax.random.PRNGKey`)."""
    if isinstance(key, (jax.Array, np.ndarray)):
        is_new_type = jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
        if is_new_type or (key.dtype == np.uint32 and key.ndim == 1):
            return
    seed = key if isinstance(key, int) and not isinstance(key, bool) else 0
    raise ValueError(f"{name} must be one random key, such as jax.random.key({seed}); it is {describe(key)}.")


MILLIMETRE_HINT = "were millimetres given for metres?"
"""Question to append to a message about a length that is larger than possible."""


def check_metres(name: str, value: Any, maximum: float = np.inf, limit: str = "") -> None:
    """Raise `ValueError` with the argument's `name` unless `value` is a positive length in metres of at most `maximum`;
    `limit` describes `maximum` in words."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be a positive length in metres; it is {describe(value)}.")
    if value > maximum:
        raise ValueError(
            f"{name} is {1e3 * float(value):g} mm, more than {limit}, {1e3 * maximum:g} mm; {MILLIMETRE_HINT}"
        )


def check_positive(name: str, value: float) -> None:
    """Raise `ValueError` unless `value` is a finite number greater than zero."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be a positive number in SI units; it is {describe(value)}.")


def check_not_negative(name: str, value: float) -> None:
    """Raise `ValueError` unless `value` is a finite number greater than or equal to zero."""
    if not (is_number(value) and value >= 0):
        raise ValueError(f"{name} must be zero or positive; it is {describe(value)}.")


def check_name(argument: str, value: Any, names: Iterable[str], otherwise: str = "") -> None:
    """Raise `ValueError`, with the name of the `argument`, unless `value` is one of `names`; `otherwise` describes
    other values that are accepted."""
    known_names = list(names)
    if not (isinstance(value, str) and value in known_names):
        problem = f"it is {describe(value)}{did_you_mean(value, known_names)}"
        raise ValueError(f"{argument} must be one of {', '.join(known_names)}{otherwise}; {problem}.")


def did_you_mean(value: Any, names: Iterable[str]) -> str:
    """Question, in brackets, that proposes the name most similar to `value`, or a name that begins with `value`; empty
    if no name is similar."""
    known_names, lowercase_value = list(names), value.lower() if isinstance(value, str) else ""
    names_with_prefix = [name for name in known_names if lowercase_value and name.startswith(lowercase_value)]
    similar_names = difflib.get_close_matches(lowercase_value, known_names, n=1) or names_with_prefix
    return f" (did you mean {similar_names[0]!r}?)" if similar_names else ""


def names_text(names: Iterable[Any], max_names: int = 8) -> str:
    """One short line of text with the first `max_names` names, such as those of arrays in a file, and the number of
    remaining names."""
    name_texts = [str(name) for name in names]
    shown_texts = [name if len(name) <= 24 else f"{name[:23]}…" for name in name_texts[:max_names]]
    remainder_text = f" and {len(name_texts) - max_names} more" if len(name_texts) > max_names else ""
    return (", ".join(shown_texts) or "nothing") + remainder_text


def check_has_values(name: str, pytree: Any, argument_use: str, instead: str) -> None:
    """Raise `ValueError` with the argument's `name` for a pytree that contains values traced by `jax.jit`, `jax.vmap`
    or a derivative; `argument_use` describes what the values are needed for, and `instead` what the user should pass or
    do."""
    if not has_values(pytree):
        raise ValueError(
            f"{name} is traced, inside jax.jit, jax.vmap or a derivative, and {argument_use} its values: {instead}."
        )


def object_text(describe_object: Callable[[], str], instance: Any) -> str:
    """Text of an object, from `describe_object`. If `describe_object` fails, which happens while JAX temporarily
    replaces arrays by other objects, the text is the name of the object's class."""
    try:
        return describe_object()
    except Exception:
        return f"<{type(instance).__name__}>"


def picture(instance: Any) -> bytes | None:
    """PNG of an object for a notebook (`_repr_png_`), or None for an object without a picture, such as a traced object.

    `jeit.report`, which draws the picture, is imported by name, because the packages of the objects must not import it.
    """
    return importlib.import_module("jeit.report.notebook").picture(instance)


def object_html(instance: Any) -> str | None:
    """HTML of an object for a notebook (`_repr_html_`): its text and its picture; None for an object without a
    picture."""
    return importlib.import_module("jeit.report.notebook").page(instance)
