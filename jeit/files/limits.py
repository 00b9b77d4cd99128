"""Limits on files that are read (memory, number of electrodes, nesting), and readers of text, TOML and JSON files that
respect the limits."""

from __future__ import annotations

import json
import os
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MAX_ELECTRODES = 1024
"""Maximum number of electrodes that a file may describe: the number of channels of a protocol grows with the square of
the number of electrodes."""

_MEMORY_LIMIT_VARIABLE, _DEFAULT_MEMORY_LIMIT_GB = "JEIT_FILE_GB", 1.0


class FileTooLargeError(ValueError):
    """Raised for a file whose content would take more memory than allowed."""


def check_memory(name: str, size: float) -> None:
    """Raise `FileTooLargeError`, a `ValueError`, if the content of the file `name` needs more memory than the limit;
    `size`: memory that the content needs, in bytes.

    The limit is a gigabyte, or the value of the environment variable JEIT_FILE_GB, in gigabytes.
    """
    max_gigabytes = _max_gigabytes()
    if size > 1e9 * max_gigabytes:
        raise FileTooLargeError(
            f"{name} would take {size / 1e9:.3g} GB in memory, more than the {max_gigabytes:g} GB that a file may. If "
            "that is meant, allow it by setting the environment variable "
            f"{_MEMORY_LIMIT_VARIABLE}={size / 1e9 + 0.5:.0f}."
        )


def check_electrodes(name: str, num_electrodes: int) -> None:
    """Raise `ValueError` if the file `name` describes more than `MAX_ELECTRODES`."""
    if num_electrodes > MAX_ELECTRODES:
        raise ValueError(
            f"{name} describes {num_electrodes} electrodes, more than {MAX_ELECTRODES}, whose "
            f"{MAX_ELECTRODES**2 // 10**6} million channels are no longer imaged; in Python there is no such limit."
        )


def max_file_memory() -> float:
    """Maximum memory in bytes for the content of a file, from the environment variable JEIT_FILE_GB. Raises
    `ValueError` if the variable is not a positive number."""
    return 1e9 * _max_gigabytes()


def _max_gigabytes() -> float:
    """Maximum memory in gigabytes for the content of a file, from the environment variable JEIT_FILE_GB."""
    try:
        gigabytes = float(os.environ.get(_MEMORY_LIMIT_VARIABLE, _DEFAULT_MEMORY_LIMIT_GB))
    except ValueError:
        gigabytes = -1.0
    if not 0 < gigabytes < float("inf"):
        raise ValueError(
            f"{_MEMORY_LIMIT_VARIABLE} must be a positive number of gigabytes; "
            f"it is {os.environ[_MEMORY_LIMIT_VARIABLE][:40]!r}."
        )
    return gigabytes


MAX_KEY_LENGTH = 40
"""Maximum number of characters of a key in a message."""
# Maximum number of characters of a message.
_MAX_MESSAGE_LENGTH = 390
# Maximum number of faults that are described in sentences.
_MAX_LISTED_FAULTS = 4
# Maximum number of further faults that are listed by their keys.
_MAX_LISTED_KEYS = 10
ALLOWED_NAMES_PREFIX = "; there are "
"""Text that precedes a list of all valid words in a message."""


def faults_message(origin: str, sentences: list[str], keys: Sequence[str] = ()) -> str:
    """Combine several faults in the file `origin` into one error message. It contains the first of the `sentences`, as
    many of the following sentences as fit, and the `keys` of up to ten of the remaining faults."""
    first_sentence = shorten(f"{shorten(origin, 2 * MAX_KEY_LENGTH)}: {sentences[0]}", _MAX_MESSAGE_LENGTH - 20)
    num_listed_keys = 1
    for num_sentences in range(min(len(sentences), _MAX_LISTED_FAULTS), 0, -1):
        # If a message proposes a valid word, its list of all valid words is omitted first to save room.
        short_sentences = [
            f"{sentence.split(ALLOWED_NAMES_PREFIX)[0]}." if "?)" + ALLOWED_NAMES_PREFIX in sentence else sentence
            for sentence in sentences[1:num_sentences]
        ]
        for later_sentences in (sentences[1:num_sentences], short_sentences):
            message = " ".join(
                [
                    first_sentence,
                    *later_sentences,
                    *_text_of_further_faults(keys[num_sentences:], len(sentences) - num_sentences, _MAX_LISTED_KEYS),
                ]
            )
            if len(message) <= _MAX_MESSAGE_LENGTH:
                return message
    while (
        len(" ".join([first_sentence, *_text_of_further_faults(keys[1:], len(sentences) - 1, num_listed_keys)]))
        <= _MAX_MESSAGE_LENGTH
        and num_listed_keys < _MAX_LISTED_KEYS
    ):
        num_listed_keys += 1
    return " ".join([first_sentence, *_text_of_further_faults(keys[1:], len(sentences) - 1, num_listed_keys - 1)])


def _text_of_further_faults(faulty_keys: Sequence[str], num_faults: int, max_keys: int) -> list[str]:
    """Sentences about `num_faults` further faults in a file; at most `max_keys` faults are named by their keys in the
    file."""
    named_keys = faulty_keys[:max_keys]
    sentences = [f"Wrong too: {', '.join(named_keys)}."] if named_keys else []
    return [*sentences, f"And {num_faults - len(named_keys)} more."] if num_faults > len(named_keys) else sentences


def shorten(text: str, max_length: int) -> str:
    """Shorten a text to at most `max_length` characters; a shortened text ends with an ellipsis."""
    return text if len(text) <= max_length else f"{text[: max_length - 1]}…"


_MAX_ERROR_TEXT_LENGTH = 120


@contextmanager
def read_as(message: str) -> Iterator[None]:
    """Context for reading files with other packages: errors of these packages become a `ValueError` with the text
    `message`, such as "not a readable WAV file", and the reason in brackets. Errors about a missing file or missing
    permission are raised unchanged.

    Warnings of these packages are suppressed, because a file that can be read counts as valid.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except Exception as error:  # of any type, since the readers of other packages do not check the content
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            raise
        raise ValueError(f"{message} ({error_text(error)}).") from None


def error_text(error: Exception) -> str:
    """Message of an error in one short line; the type of the error if it has no message."""
    text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return text if len(text) <= _MAX_ERROR_TEXT_LENGTH else f"{text[: _MAX_ERROR_TEXT_LENGTH - 1]}…"


# Maximum size in bytes of a hand-written TOML file.
_MAX_TOML_BYTES = 2**22
# Bytes of memory per byte of text.
_BYTES_PER_CHARACTER = 4
# Maximum number of parts of a dotted key.
_MAX_KEY_PARTS = 32


def read_text(path: str | Path, *, encoding: str = "utf-8", max_bytes: int | None = None) -> str:
    """Read the text of a file of at most `max_bytes` bytes, whose content must not exceed the memory limit
    (`check_memory`).

    The errors state the file's name: `ValueError` if the file is larger, `UnicodeError` (a `ValueError`) if it is not
    text, and `OSError` if it does not exist.
    """
    path = Path(path)
    check_size(path, max_bytes)
    file_bytes = path.read_bytes()
    try:
        return file_bytes.decode(encoding)
    except UnicodeDecodeError:
        raise UnicodeError(f"{path.name} is no text in UTF-8.") from None


def check_size(path: Path, max_bytes: int | None = None) -> None:
    """Raise `ValueError` if a file has more than `max_bytes` bytes, or if its content exceeds the memory limit
    (`check_memory`)."""
    num_bytes = path.stat().st_size
    if max_bytes is not None and num_bytes > max_bytes:
        raise ValueError(
            f"{path.name} has {num_bytes} bytes, and a file of its kind {max_bytes} at most: is it the right one?"
        )
    check_memory(path.name, _BYTES_PER_CHARACTER * num_bytes)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read the content of a hand-written TOML file. Raises `ValueError`, with the file's name and the line, for invalid
    TOML, and `OSError` if the file does not exist."""
    return parsed_toml(read_text(path, max_bytes=_MAX_TOML_BYTES), Path(path).name)


def parsed_toml(text: str, name: str) -> dict[str, Any]:
    """Parse `text` from the TOML file `name`. Raises `ValueError` for invalid TOML."""
    if any(_max_dots_per_key(line) > _MAX_KEY_PARTS for line in text.splitlines()):
        raise ValueError(f"{name} has a key of more than {_MAX_KEY_PARTS} parts; none is of so many.")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"{name} is nested too deep.") from None
    except ValueError as error:  # TOMLDecodeError, and numbers of too many digits
        raise ValueError(f"{name} is no TOML file: {error_text(error)}.") from None


def _max_dots_per_key(line: str) -> int:
    """Maximum number of dots in a key on a line of TOML: the parser's time grows with the square of that number."""
    if "=" not in line:
        return line.count(".") if line.lstrip().startswith("[") and "," not in line else 0
    key_prefixes = [key_part.rpartition("{")[2].rpartition(",")[2] for key_part in line.split("=")[:-1]]
    return max(key_part.count(".") for key_part in key_prefixes)


def read_json(path: str | Path, *, max_bytes: int = 2**26) -> Any:
    """Read a JSON file of at most `max_bytes` bytes. Raises `ValueError`, with the file's name and the position, for
    invalid JSON, and `OSError` if the file does not exist."""
    path = Path(path)
    try:
        return json.loads(read_text(path, max_bytes=max_bytes))
    except RecursionError:
        raise ValueError(f"{path.name} is nested too deep.") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path.name} is no JSON file: {error_text(error)}.") from None
