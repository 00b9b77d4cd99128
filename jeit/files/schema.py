"""Validation of hand-written files: tables of keys with types, ranges and units. All faults are reported at once.

A table is defined by a class derived from `Table`, with one line per key:

    class SkinTable(Table):
        what = "a skin"
        model: Literal["sheet", "layer"] = "sheet"
        width_mm: Annotated[float, Number(5, 5000, "mm")]

`validated` creates an instance from the content of a TOML or JSON file. This module imports pydantic, so readers import
it only when they read a file.
"""

from __future__ import annotations

import itertools
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, FailFast, Field, GetCoreSchemaHandler, ValidationError, model_validator
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, core_schema

from jeit.arguments import IN_MILLIMETRES, describe, did_you_mean
from jeit.files.limits import ALL, KEY, cut, faults_message

# Maximum number of characters of a list of names in a message.
_NAMES = 160
# Keys of sizes that a message mentions along with the shape that is probably meant.
_SIZES = ("radius", "width", "depth", "height", "vertices", "tags")
_LARGEST = sys.float_info.max
# Maximum number of unknown keys of a table that are examined.
_UNKNOWN = 100


class Table(BaseModel):
    """Base class of the tables of a file: rejects unknown keys, and text or booleans where a number is expected."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True, defer_build=True)

    what: ClassVar[str] = "the file"
    """Name in messages of the thing that the table describes, such as "a study"."""
    hints: ClassVar[dict[str, str]] = {}
    """What to write for a missing key whose value is often not known; continues the sentence "give it"."""

    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, given: Any, made: Callable[[Any], Any]) -> Any:
        """Convert each fault to a sentence that begins with the key."""
        if isinstance(given, Mapping) and len(given) > len(cls.model_fields) + _UNKNOWN:
            # Otherwise each of possibly a million unknown keys would be reported.
            unknown = itertools.islice((key for key in given if key not in cls.model_fields), _UNKNOWN)
            given = {key: given[key] for key in [*(key for key in cls.model_fields if key in given), *unknown]}
        try:
            return made(cls._spelled(given) if isinstance(given, Mapping) else given)
        except ValidationError as error:
            faults = [
                InitErrorDetails(type=fault(cls._said(one)), loc=_steps(one), input=0)
                for one in error.errors(include_url=False)
            ]
            raise ValidationError.from_exception_data(cls.what, faults) from None

    @classmethod
    def _spelled(cls, given: Mapping[Any, Any]) -> dict[Any, Any]:
        """The table, with hyphens and underscores in words as in the words that a key may have."""
        known = {key: one.annotation for key, one in cls.model_fields.items()}
        return {key: spelled(value, _words(known[key])) if key in known else value for key, value in given.items()}

    @classmethod
    def _said(cls, one: Any) -> str:
        given, context = one["input"], one.get("ctx", {})
        match one["type"]:
            case "fault":
                return context["said"]
            case "missing":
                return f"is missing; give it{cls.hints.get(str(one['loc'][-1]), '')}."
            case "extra_forbidden":
                known = [*cls.model_fields]
                meant = did_you_mean(str(one["loc"][-1])[:KEY], known)
                return f"is no key of {cls.what}{meant}{ALL}{_few(known)}."
            case "literal_error":
                return not_among(given, re.findall("'([^']+)'", context["expected"]))
            case "bool_type" if not isinstance(given, list):
                return f"must be true or false, without quotes; it is {describe(given)}."
            case "bool_type":
                return "takes one value, not a list: true or false."
            case "string_type":
                return f"must be text in quotes; it is {describe(given)}."
            case "string_too_short":
                return "is empty text; write some."
            case "string_too_long":
                return f"is text of {len(given)} characters; write {context['max_length']} or fewer."
            case "list_type":
                return f"must be a list; it is {describe(given)}."
            case "too_short":
                return f"has {context['actual_length']} things in it; give {context['min_length']} at least."
            case "too_long":
                return f"has more than the {context['max_length']} that it may."
            case "model_type":
                return f"must be a table, with keys of its own; it is {describe(given)}."
            case kind:
                return f"is {describe(given)}, which cannot be ({kind})."


T = TypeVar("T", bound=Table)

Word = Annotated[str, Field(min_length=1, max_length=200)]
"""One line of text."""
Words = Annotated[list[Word], FailFast()]
"""A list of lines of text."""


def spelled(given: Any, words: Iterable[str]) -> Any:
    """The one of `words` that differs from `given` by hyphens and underscores alone, or `given`."""
    if not isinstance(given, str):
        return given
    return next((word for word in words if word.replace("_", "-") == given.replace("_", "-")), given)


def _words(annotation: Any) -> list[str]:
    """Words that a key with this annotation may have."""
    inner = get_args(annotation)
    if get_origin(annotation) is Literal:
        return [one for one in inner if isinstance(one, str)]
    return [word for one in inner if get_origin(one) is Literal for word in _words(one)]


def fault(said: str, key: str = "") -> PydanticCustomError:
    """Error for checks of a table to raise: the message `said` about the `key` in the table, or about the table itself.
    The name is put before the message."""
    return PydanticCustomError("fault", "{said}", {"said": said, "key": key})


@dataclass(frozen=True)
class Number:
    """Annotation of a key whose value is a number from `low` to `high`, an integer if the key has type int.

    If the type is a list, the key can be swept: its value is a number, or a list of distinct numbers. `beyond`: message
    about numbers that are too large.
    """

    low: float
    high: float
    unit: str = ""
    beyond: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        swept = get_origin(source) is list
        whole = (get_args(source)[0] if swept else source) is int

        def read(given: Any) -> Any:
            if swept:
                return [self.read(one, whole, " or a list of them") for one in _swept_values(given)]
            if isinstance(given, list):
                raise fault("takes one value, not a list.")
            return self.read(given, whole)

        return core_schema.no_info_plain_validator_function(read)

    def read(self, given: Any, whole: bool = False, otherwise: str = "") -> float:
        """Check and convert a number. Raises `fault` for invalid values."""
        if not _is_number(given, whole):
            wanted = "a whole number" if whole else "a number"
            raise fault(f"must be {wanted}{otherwise}, {self.span}; it is {describe(given)}.")
        if given > _LARGEST and math.isinf(self.high):
            raise fault(f"is {describe(given)}, beyond double precision.")
        if not self.low <= given <= self.high:
            shown = f"{given:g}" if isinstance(given, float) else describe(given)
            hint = f" {self.beyond}" if self.beyond and given > self.high else "" if whole else self._hint(given)
            raise fault(f"is {shown}, and must be {self.span}.{hint}")
        return int(given) if whole else float(given)

    @property
    def span(self) -> str:
        """The range and the unit, as text."""
        low = "above 0" if 0 < self.low < 1e-300 else f"from {_plain(self.low)}"
        high = " up" if low[0] == "f" else ""
        high = high if math.isinf(self.high) else f" to {_plain(self.high)}"
        return f"{low}{high}{f' {self.unit}' if self.unit else ''}"

    def _hint(self, given: float) -> str:
        """Propose a value for a number that is off by a factor of 1000; not for units without such prefixes."""
        if self.unit in ("", "%", "degrees") or math.isinf(self.high) or abs(given) > 1e100:
            return ""
        for larger, metric in ((True, "metres"), (False, "micrometres")):
            if not (self.low <= 1000 * given <= self.high if larger else self.low <= given / 1000 <= self.high):
                continue
            if self.unit == "m":
                return "" if larger else f" {given:g} mm are {given / 1000:g} m. {IN_MILLIMETRES.capitalize()}"
            other = f"in {metric}" if self.unit == "mm" else "off by a factor of 1000"
            return f" Is it {other}? Then write {1000 * given if larger else given / 1000:g}."
        return ""


@dataclass(frozen=True)
class Numbers:
    """Annotation of a key whose value is an array of numbers from `low` to `high`, of integers, or of booleans; `kind`
    is the type.

    `axes`: minimum and maximum length of each axis. `single`: whether one number for all is accepted, too.
    """

    axes: tuple[tuple[int, float], ...]
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    kind: type = float
    single: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._read)

    def _read(self, given: Any) -> np.ndarray:
        given = given.tolist() if isinstance(given, np.ndarray) else given
        if self.single and not isinstance(given, (list, tuple)):
            number = Number(self.low, self.high, self.unit)
            return np.asarray(number.read(given, self.kind is int, f" or a list, {self._counts}"))
        rows = self._counted(given, 0) if len(self.axes) == 2 else [given]
        for row in rows:
            if len(self._counted(row, -1)) != len(rows[0]):
                raise fault(f"must be {self._wanted}; it has rows of {len(rows[0])} and of {len(row)}.")
        wrong = next((item for row in rows for item in row if not self._right(item)), None)
        if wrong is not None:
            raise fault(f"must be {self._wanted}; it has {describe(wrong)} in it.")
        return np.array(given, self.kind)

    def _counted(self, given: Any, axis: int) -> Any:
        if not isinstance(given, (list, tuple)):
            which = "it is" if axis == 0 or len(self.axes) == 1 else "a row is"
            raise fault(f"must be {self._wanted}; {which} {describe(given)}.")
        least, most = self.axes[axis]
        if not least <= len(given) <= most:
            raise fault(
                f"must be {self._wanted}; it has {len(given)}{' in a row' if axis and len(self.axes) == 2 else ''}."
            )
        return given

    def _right(self, item: Any) -> bool:
        if self.kind is bool:
            return isinstance(item, bool)
        return _is_number(item, self.kind is int) and max(self.low, -_LARGEST) <= item <= min(self.high, _LARGEST)

    @property
    def _counts(self) -> str:
        return " × ".join(
            str(least) if least == most else f"{least} or more" if math.isinf(most) else f"{least} to {most:g}"
            for least, most in self.axes
        )

    @property
    def _wanted(self) -> str:
        name = {float: "numbers", int: "whole numbers", bool: "true or false"}[self.kind]
        unbounded = math.isinf(self.low)
        return f"{self._counts} {name}{'' if unbounded else f', {Number(self.low, self.high, self.unit).span}'}"


class Swept:
    """Annotation of a key whose value is a list of distinct items; a value that is not a list counts as a list of
    one."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def read(given: Any, inner: Callable[[list], list]) -> list:
            if isinstance(given, list):
                return inner(_swept_values(given))
            try:
                return inner([given])
            except ValidationError as error:
                one = error.errors(include_url=False)[0]
                alone = InitErrorDetails(type=one["type"], loc=one["loc"][1:], input=given, ctx=one.get("ctx", {}))
            raise ValidationError.from_exception_data("", [alone])

        return core_schema.no_info_wrap_validator_function(read, handler(source))


Item = TypeVar("Item")
Several = Annotated[list[Item], FailFast(), Swept()]
"""A list of distinct items, or a single item."""


class OneOf:
    """Annotation of a key whose value is one of several tables, chosen by the word under `key` in it.

    Without that word, the table with a default for `key` is chosen. If the key `mark` is present, the table `other` is
    chosen. `meant`: other words that users may write, and the valid word that each probably means.
    """

    def __init__(
        self,
        key: str,
        *tables: type[Table],
        mark: str = "",
        other: type[Table] | None = None,
        meant: Mapping[str, str] | None = None,
    ):
        self.key, self.mark, self.other, self.meant = key, mark, other, meant or {}
        self.tables = {word: one for one in tables for word in get_args(one.model_fields[key].annotation)}
        self.usual = next((one for one in tables if not one.model_fields[key].is_required()), None)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._read)

    def _read(self, given: Any) -> Table:
        if not isinstance(given, Mapping):
            raise fault(f"must be a table, with keys of its own; it is {describe(given)}.")
        if self.other is not None and self.mark in given:
            return self.other.model_validate(given)
        if self.key not in given:
            if self.usual is None:
                end = f", or {self.mark}" if self.mark else ""
                raise fault(f"is missing; give it, one of {_few(self.tables)}{end}.", self.key)
            return self.usual.model_validate(given)
        word = spelled(given[self.key], self.tables)
        if not (isinstance(word, str) and word in self.tables):
            raise fault(not_among(word, self.tables, self._likely(word)), self.key)
        return self.tables[word].model_validate({**given, self.key: word})

    def _likely(self, word: Any) -> str:
        """Text that proposes the valid word that is probably meant by `word`, with the sizes that it needs."""
        meant = self.meant.get(word.lower().rstrip("s")) if isinstance(word, str) else None
        if meant is None:
            return ""
        sizes = [name for name, one in self.tables[meant].model_fields.items() if one.is_required() and name in _SIZES]
        return f" (did you mean {meant!r}, with {' and '.join(sizes)}?)"


def validated(table: type[T], given: Any, origin: str) -> T:
    """Validate `given` and return the table. Raises one `ValueError` of at most 400 characters that begins with
    `origin`, the file's name, and has a sentence on each faulty key, or on as many as there is room for."""
    try:
        return table.model_validate(given)
    except ValidationError as error:
        faults = error.errors(include_url=False, include_input=False)
    keys = [_place(_steps(one)) for one in faults]
    said = [f"{key}{one['msg']}" for key, one in zip(keys, faults, strict=True)]
    raise ValueError(faults_message(origin, said, [key.strip() for key in keys]))


def not_among(given: Any, words: Iterable[str], likely: str = "") -> str:
    """Message about a word that is not one of `words`; `likely`: text that proposes a word, if known."""
    known = [*words]
    meant = likely or did_you_mean(given[:KEY] if isinstance(given, str) else given, known)
    return f"must be one of {_few(known)}; it is {describe(given)}{meant}."


def _steps(one: Any) -> tuple[int | str, ...]:
    """Path of keys to a fault."""
    key = one.get("ctx", {}).get("key")
    return (*one["loc"], key) if key else one["loc"]


def _place(steps: tuple[int | str, ...]) -> str:
    """Full name of the key that a fault is about, such as microphones[3].b."""
    said = ""
    for step in steps:
        said += f"[{step}]" if isinstance(step, int) else f"{'.' if said else ''}{_key(step)}"
    return f"{said} " if said else ""


def _key(name: str) -> str:
    short = cut(name, KEY)
    return short if re.fullmatch(r"[\w.-]+…?", short) else repr(short)


def _swept_values(given: Any) -> list:
    """Values of a swept key as a list."""
    if not isinstance(given, list):
        return [given]
    if not given:
        raise fault("is an empty list; give one value at least.")
    plain = [one for one in given if isinstance(one, (str, Real))]
    if len(set(plain)) < len(plain):
        raise fault("lists a value twice; give each once.")
    return given


def _is_number(given: Any, whole: bool) -> bool:
    if isinstance(given, bool) or not isinstance(given, Integral if whole else Real):
        return False
    return not isinstance(given, float) or math.isfinite(given)


def _plain(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"


def _few(names: Iterable[str]) -> str:
    return cut(", ".join(names), _NAMES)
