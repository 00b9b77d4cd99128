"""Names of what there is, and which of them was meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from jeit.arguments.kinds import told


def check_name(argument: str, given: Any, names: Iterable[str], otherwise: str = "") -> None:
    """Raise `ValueError`, about `argument`, for what is none of `names`; `otherwise` says what else could be given."""
    known = list(names)
    if not (isinstance(given, str) and given in known):
        said = f"it is {told(given)}{did_you_mean(given, known)}"
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
