"""Sections of a description: what is unknown, missing or not among the choices is said with file, section and key."""

from collections.abc import Iterable
from typing import Any

from jeit.arguments import did_you_mean


def refuse_unknown(section: dict, known: Iterable[str], origin: str, where: str) -> None:
    """Raise `ValueError` for keys that are not `known`."""
    unknown = sorted(set(section) - set(known))
    if unknown:
        raise ValueError(f"{origin}: {where} has no '{unknown[0]}'. Known there: {', '.join(sorted(known))}.")


def need(section: dict, key: str, origin: str, where: str) -> Any:
    """The value of a key that must be there. Raises `ValueError`."""
    if key not in section:
        raise ValueError(f"{origin}: {where} needs '{key}'.")
    return section[key]


def choice(value: Any, choices: Iterable[str], origin: str, where: str) -> Any:
    """A value that must be among some. Raises `ValueError`."""
    names = [str(one) for one in choices]
    if value not in names:
        raise ValueError(
            f"{origin}: {where} must be one of {', '.join(names)}; got {value!r}{did_you_mean(value, names)}."
        )
    return value


def located(error: Exception, origin: str, where: str) -> ValueError:
    """An error with the place that it is about."""
    text = str(error)
    return ValueError(text if text.startswith(origin) else f"{origin}: {where}: {text}")
