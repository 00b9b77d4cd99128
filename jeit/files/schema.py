"""Validation of hand-written TOML and JSON files against tables of keys with types, ranges and units. All faults of a
file are reported at once.

A table is defined by a class derived from `Table`, with one line per key:

    class SkinTable(Table):
        name_in_messages = "a skin"
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

from jeit.arguments import MILLIMETRE_HINT, describe, did_you_mean
from jeit.files.limits import ALLOWED_NAMES_PREFIX, MAX_KEY_LENGTH, faults_message, shorten

# Maximum number of characters of a list of names in a message.
_MAX_NAME_LIST_LENGTH = 160
# Keys of sizes that an error message mentions together with the shape that the user probably means.
_SIZE_KEYS = ("radius", "width", "depth", "height", "vertices", "tags")
_MAX_FLOAT = sys.float_info.max
# Maximum number of unknown keys of a table that are checked and reported.
_MAX_UNKNOWN_KEYS = 100


class Table(BaseModel):
    """Base class of the tables of a hand-written file: rejects unknown keys, and text or booleans where a number is
    expected."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True, defer_build=True)

    name_in_messages: ClassVar[str] = "the file"
    """Name, in messages, of the object that the table describes, such as "a study"."""
    hints: ClassVar[dict[str, str]] = {}
    """For each key whose value users often do not know: advice on what to write if the key is missing, which continues
    the sentence "give it"."""

    @model_validator(mode="wrap")
    @classmethod
    def _validate_with_worded_faults(cls, value: Any, validate_table: Callable[[Any], Any]) -> Any:
        """Validate a table of a file, and convert each fault to a sentence that begins with the faulty key."""
        if isinstance(value, Mapping) and len(value) > len(cls.model_fields) + _MAX_UNKNOWN_KEYS:
            # Without this limit, each unknown key would be reported, possibly a million.
            unknown_keys = itertools.islice((key for key in value if key not in cls.model_fields), _MAX_UNKNOWN_KEYS)
            value = {key: value[key] for key in [*(key for key in cls.model_fields if key in value), *unknown_keys]}
        try:
            return validate_table(cls._with_known_spelling(value) if isinstance(value, Mapping) else value)
        except ValidationError as error:
            line_errors = [
                InitErrorDetails(type=fault(cls._fault_message(fault_details)), loc=_fault_path(fault_details), input=0)
                for fault_details in error.errors(include_url=False)
            ]
            raise ValidationError.from_exception_data(cls.name_in_messages, line_errors) from None

    @classmethod
    def _with_known_spelling(cls, file_table: Mapping[Any, Any]) -> dict[Any, Any]:
        """Copy of the table, in which text values that differ from an allowed word only by hyphens and underscores are
        replaced by the allowed word."""
        key_annotations = {key: key_field.annotation for key, key_field in cls.model_fields.items()}
        return {
            key: match_spelling(value, _allowed_words(key_annotations[key])) if key in key_annotations else value
            for key, value in file_table.items()
        }

    @classmethod
    def _fault_message(cls, fault_details: Any) -> str:
        faulty_value, fault_context = fault_details["input"], fault_details.get("ctx", {})
        match fault_details["type"]:
            case "fault":
                return fault_context["said"]
            case "missing":
                return f"is missing; give it{cls.hints.get(str(fault_details['loc'][-1]), '')}."
            case "extra_forbidden":
                known_keys = [*cls.model_fields]
                suggestion = did_you_mean(str(fault_details["loc"][-1])[:MAX_KEY_LENGTH], known_keys)
                return (
                    f"is no key of {cls.name_in_messages}{suggestion}{ALLOWED_NAMES_PREFIX}{_list_names(known_keys)}."
                )
            case "literal_error":
                return not_among(faulty_value, re.findall("'([^']+)'", fault_context["expected"]))
            case "bool_type" if not isinstance(faulty_value, list):
                return f"must be true or false, without quotes; it is {describe(faulty_value)}."
            case "bool_type":
                return "takes one value, not a list: true or false."
            case "string_type":
                return f"must be text in quotes; it is {describe(faulty_value)}."
            case "string_too_short":
                return "is empty text; write some."
            case "string_too_long":
                return f"is text of {len(faulty_value)} characters; write {fault_context['max_length']} or fewer."
            case "list_type":
                return f"must be a list; it is {describe(faulty_value)}."
            case "too_short":
                return (
                    f"has {fault_context['actual_length']} things in it; give {fault_context['min_length']} at least."
                )
            case "too_long":
                return f"has more than the {fault_context['max_length']} that it may."
            case "model_type":
                return f"must be a table, with keys of its own; it is {describe(faulty_value)}."
            case fault_type:
                return f"is {describe(faulty_value)}, which cannot be ({fault_type})."


T = TypeVar("T", bound=Table)

Word = Annotated[str, Field(min_length=1, max_length=200)]
"""One line of text."""
Words = Annotated[list[Word], FailFast()]
"""A list of lines of text."""


def match_spelling(value: Any, allowed_words: Iterable[str]) -> Any:
    """Return the word in `allowed_words` that differs from `value` only by hyphens and underscores; `value` if there is
    no such word."""
    if not isinstance(value, str):
        return value
    return next((word for word in allowed_words if word.replace("_", "-") == value.replace("_", "-")), value)


def _allowed_words(type_annotation: Any) -> list[str]:
    """Words that are allowed as the value of a key with this type annotation."""
    type_arguments = get_args(type_annotation)
    if get_origin(type_annotation) is Literal:
        return [type_argument for type_argument in type_arguments if isinstance(type_argument, str)]
    return [
        word
        for type_argument in type_arguments
        if get_origin(type_argument) is Literal
        for word in _allowed_words(type_argument)
    ]


def fault(message: str, key: str = "") -> PydanticCustomError:
    """Create the error that the checks of a table raise: a `message` about the `key` in the table, or about the whole
    table if `key` is empty. The reported message begins with the name of the key or table."""
    return PydanticCustomError("fault", "{said}", {"said": message, "key": key})


@dataclass(frozen=True)
class Number:
    """Annotation of a key whose value is a number from `low` to `high`, an integer if the key has type int.

    If the key's type is a list, the key can be swept: its value is a number, or a list of distinct numbers. `beyond`:
    error message for numbers that are too large.
    """

    low: float
    high: float
    unit: str = ""
    beyond: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        is_swept = get_origin(source) is list
        is_integer = (get_args(source)[0] if is_swept else source) is int

        def read_value(value: Any) -> Any:
            if is_swept:
                return [self.read(item, is_integer, " or a list of them") for item in _swept_values(value)]
            if isinstance(value, list):
                raise fault("takes one value, not a list.")
            return self.read(value, is_integer)

        return core_schema.no_info_plain_validator_function(read_value)

    def read(self, value: Any, is_integer: bool = False, otherwise: str = "") -> float:
        """Check a value and convert it to a number. Raises an error created by `fault` for invalid values."""
        if not _is_number(value, is_integer):
            required_type = "a whole number" if is_integer else "a number"
            raise fault(f"must be {required_type}{otherwise}, {self.span}; it is {describe(value)}.")
        if value > _MAX_FLOAT and math.isinf(self.high):
            raise fault(f"is {describe(value)}, beyond double precision.")
        if not self.low <= value <= self.high:
            value_text = f"{value:g}" if isinstance(value, float) else describe(value)
            range_hint = (
                f" {self.beyond}" if self.beyond and value > self.high else "" if is_integer else self._unit_hint(value)
            )
            raise fault(f"is {value_text}, and must be {self.span}.{range_hint}")
        return int(value) if is_integer else float(value)

    @property
    def span(self) -> str:
        """The allowed range and the unit, as text."""
        low_text = "above 0" if 0 < self.low < 1e-300 else f"from {_number_text(self.low)}"
        high_text = " up" if low_text[0] == "f" else ""
        high_text = high_text if math.isinf(self.high) else f" to {_number_text(self.high)}"
        return f"{low_text}{high_text}{f' {self.unit}' if self.unit else ''}"

    def _unit_hint(self, value: float) -> str:
        """Text that proposes a value for a number that is too large or too small by a factor of 1000; empty for units
        without a prefix such as milli."""
        if self.unit in ("", "%", "degrees") or math.isinf(self.high) or abs(value) > 1e100:
            return ""
        for is_larger, suggested_unit in ((True, "metres"), (False, "micrometres")):
            if not (self.low <= 1000 * value <= self.high if is_larger else self.low <= value / 1000 <= self.high):
                continue
            if self.unit == "m":
                return "" if is_larger else f" {value:g} mm are {value / 1000:g} m. {MILLIMETRE_HINT.capitalize()}"
            suggestion = f"in {suggested_unit}" if self.unit == "mm" else "off by a factor of 1000"
            return f" Is it {suggestion}? Then write {1000 * value if is_larger else value / 1000:g}."
        return ""


@dataclass(frozen=True)
class Numbers:
    """Annotation of a key whose value is an array of numbers from `low` to `high`, or of booleans; `kind` is the type
    of the items.

    `axes`: minimum and maximum length of each axis. `single`: whether a single number instead of an array is accepted,
    too.
    """

    axes: tuple[tuple[int, float], ...]
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    kind: type = float
    single: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validate_value)

    def _validate_value(self, values: Any) -> np.ndarray:
        values = values.tolist() if isinstance(values, np.ndarray) else values
        if self.single and not isinstance(values, (list, tuple)):
            number = Number(self.low, self.high, self.unit)
            return np.asarray(number.read(values, self.kind is int, f" or a list, {self._expected_lengths_text}"))
        rows = self._check_length(values, 0) if len(self.axes) == 2 else [values]
        for row in rows:
            if len(self._check_length(row, -1)) != len(rows[0]):
                raise fault(f"must be {self._expected_text}; it has rows of {len(rows[0])} and of {len(row)}.")
        invalid_item = next((array_item for row in rows for array_item in row if not self._is_valid(array_item)), None)
        if invalid_item is not None:
            raise fault(f"must be {self._expected_text}; it has {describe(invalid_item)} in it.")
        return np.array(values, self.kind)

    def _check_length(self, values: Any, axis_number: int) -> Any:
        if not isinstance(values, (list, tuple)):
            sentence_beginning = "it is" if axis_number == 0 or len(self.axes) == 1 else "a row is"
            raise fault(f"must be {self._expected_text}; {sentence_beginning} {describe(values)}.")
        min_length, max_length = self.axes[axis_number]
        if not min_length <= len(values) <= max_length:
            raise fault(
                f"must be {self._expected_text}; it has "
                f"{len(values)}{' in a row' if axis_number and len(self.axes) == 2 else ''}."
            )
        return values

    def _is_valid(self, array_item: Any) -> bool:
        if self.kind is bool:
            return isinstance(array_item, bool)
        return _is_number(array_item, self.kind is int) and max(self.low, -_MAX_FLOAT) <= array_item <= min(
            self.high, _MAX_FLOAT
        )

    @property
    def _expected_lengths_text(self) -> str:
        return " × ".join(
            str(min_length)
            if min_length == max_length
            else f"{min_length} or more"
            if math.isinf(max_length)
            else f"{min_length} to {max_length:g}"
            for min_length, max_length in self.axes
        )

    @property
    def _expected_text(self) -> str:
        type_name = {float: "numbers", int: "whole numbers", bool: "true or false"}[self.kind]
        range_text = "" if math.isinf(self.low) else f", {Number(self.low, self.high, self.unit).span}"
        return f"{self._expected_lengths_text} {type_name}{range_text}"


class SweptValues:
    """Annotation of a key whose value is a list of distinct items; a value that is not a list counts as a list of one
    item."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def read_value(value: Any, validate: Callable[[list], list]) -> list:
            if isinstance(value, list):
                return validate(_swept_values(value))
            try:
                return validate([value])
            except ValidationError as error:
                first_fault = error.errors(include_url=False)[0]
                line_error = InitErrorDetails(
                    type=first_fault["type"], loc=first_fault["loc"][1:], input=value, ctx=first_fault.get("ctx", {})
                )
            raise ValidationError.from_exception_data("", [line_error])

        return core_schema.no_info_wrap_validator_function(read_value, handler(source))


Item = TypeVar("Item")
SweptList = Annotated[list[Item], FailFast(), SweptValues()]
"""A list of distinct items, or a single item."""


class TableOfKind:
    """Annotation of a key whose value is a table of one of several kinds; the word that the table contains under `key`
    selects the kind.

    If `key` is missing, the kind with a default for `key` is selected. If `alternative_key` is present, the kind
    `alternative_table` is selected. `synonyms`: for each wrong word that users may write, the valid word that is
    probably meant.
    """

    def __init__(
        self,
        key: str,
        *tables: type[Table],
        alternative_key: str = "",
        alternative_table: type[Table] | None = None,
        synonyms: Mapping[str, str] | None = None,
    ):
        self.key, self.synonyms = key, synonyms or {}
        self.alternative_key, self.alternative_table = alternative_key, alternative_table
        self.tables = {word: table for table in tables for word in get_args(table.model_fields[key].annotation)}
        self.default_table = next((table for table in tables if not table.model_fields[key].is_required()), None)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validate_value)

    def _validate_value(self, value: Any) -> Table:
        if not isinstance(value, Mapping):
            raise fault(f"must be a table, with keys of its own; it is {describe(value)}.")
        if self.alternative_table is not None and self.alternative_key in value:
            return self.alternative_table.model_validate(value)
        if self.key not in value:
            if self.default_table is None:
                alternative_text = f", or {self.alternative_key}" if self.alternative_key else ""
                raise fault(f"is missing; give it, one of {_list_names(self.tables)}{alternative_text}.", self.key)
            return self.default_table.model_validate(value)
        word = match_spelling(value[self.key], self.tables)
        if not (isinstance(word, str) and word in self.tables):
            raise fault(not_among(word, self.tables, self._synonym_suggestion(word)), self.key)
        return self.tables[word].model_validate({**value, self.key: word})

    def _synonym_suggestion(self, unknown_word: Any) -> str:
        """Text that proposes the valid word that is probably meant by `unknown_word`, with the keys of sizes that this
        kind of table needs."""
        valid_word = self.synonyms.get(unknown_word.lower().rstrip("s")) if isinstance(unknown_word, str) else None
        if valid_word is None:
            return ""
        size_keys = [
            key_name
            for key_name, key_field in self.tables[valid_word].model_fields.items()
            if key_field.is_required() and key_name in _SIZE_KEYS
        ]
        return f" (did you mean {valid_word!r}, with {' and '.join(size_keys)}?)"


def validated(table: type[T], table_values: Any, origin: str) -> T:
    """Validate the `table_values` of a file and return them as a `table`. Raises one `ValueError` of at most 400
    characters, which begins with `origin`, the file's name. It contains a sentence about each faulty key, or about as
    many keys as fit."""
    try:
        return table.model_validate(table_values)
    except ValidationError as error:
        faults = error.errors(include_url=False, include_input=False)
    keys = [_full_key_name(_fault_path(fault_details)) for fault_details in faults]
    sentences = [f"{key}{fault_details['msg']}" for key, fault_details in zip(keys, faults, strict=True)]
    raise ValueError(faults_message(origin, sentences, [key.strip() for key in keys]))


def not_among(value: Any, words: Iterable[str], suggestion_text: str = "") -> str:
    """Error message for a value that is not one of `words`; `suggestion_text`: text that proposes a word."""
    known_words = [*words]
    suggestion = suggestion_text or did_you_mean(
        value[:MAX_KEY_LENGTH] if isinstance(value, str) else value, known_words
    )
    return f"must be one of {_list_names(known_words)}; it is {describe(value)}{suggestion}."


def _fault_path(fault_details: Any) -> tuple[int | str, ...]:
    """Path of keys and indices that leads to a faulty value in a file."""
    key = fault_details.get("ctx", {}).get("key")
    return (*fault_details["loc"], key) if key else fault_details["loc"]


def _full_key_name(key_path: tuple[int | str, ...]) -> str:
    """Full name of a faulty key in a file, such as microphones[3].b."""
    full_name = ""
    for key_or_index in key_path:
        full_name += (
            f"[{key_or_index}]"
            if isinstance(key_or_index, int)
            else f"{'.' if full_name else ''}{_short_key(key_or_index)}"
        )
    return f"{full_name} " if full_name else ""


def _short_key(name: str) -> str:
    shortened_name = shorten(name, MAX_KEY_LENGTH)
    return shortened_name if re.fullmatch(r"[\w.-]+…?", shortened_name) else repr(shortened_name)


def _swept_values(value: Any) -> list:
    """The value of a swept key as a list; a single value becomes a list of one item."""
    if not isinstance(value, list):
        return [value]
    if not value:
        raise fault("is an empty list; give one value at least.")
    scalar_items = [item for item in value if isinstance(item, (str, Real))]
    if len(set(scalar_items)) < len(scalar_items):
        raise fault("lists a value twice; give each once.")
    return value


def _is_number(value: Any, is_integer: bool) -> bool:
    if isinstance(value, bool) or not isinstance(value, Integral if is_integer else Real):
        return False
    return not isinstance(value, float) or math.isfinite(value)


def _number_text(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"


def _list_names(listed_names: Iterable[str]) -> str:
    return shorten(", ".join(listed_names), _MAX_NAME_LIST_LENGTH)
