"""Several faults of a file in one message: those there is room for as sentences, others by their keys."""

from __future__ import annotations

from collections.abc import Sequence

KEY = 40
"""Letters of a key in a message, at most."""
# Letters of a whole message, at most; how many faults are told in sentences, and how many more by their keys.
_LONGEST, _FAULTS, _KEYS = 390, 4, 10
ALL = "; there are "
"""What goes before all the words that there are."""


def told_faults(origin: str, sentences: list[str], keys: Sequence[str] = ()) -> str:
    """One message of several `sentences` about the file `origin`: the first, and more as far as there is room beside
    the `keys` that the others are about, of which up to ten are named."""
    first = cut(f"{cut(origin, 2 * KEY)}: {sentences[0]}", _LONGEST - 20)
    shown = 1
    for number in range(min(len(sentences), _FAULTS), 0, -1):
        # Where there is a word that is likely meant, the list of all has to make room first.
        rest = [f"{one.split(ALL)[0]}." if "?)" + ALL in one else one for one in sentences[1:number]]
        for others in (sentences[1:number], rest):
            message = " ".join([first, *others, *_more(keys[number:], len(sentences) - number, _KEYS)])
            if len(message) <= _LONGEST:
                return message
    while len(" ".join([first, *_more(keys[1:], len(sentences) - 1, shown)])) <= _LONGEST and shown < _KEYS:
        shown += 1
    return " ".join([first, *_more(keys[1:], len(sentences) - 1, shown - 1)])


def _more(keys: Sequence[str], number: int, most: int) -> list[str]:
    """What is said of a `number` of faults that there is no room for, of which at most so many are named by key."""
    named = keys[:most]
    said = [f"Wrong too: {', '.join(named)}."] if named else []
    return [*said, f"And {number - len(named)} more."] if number > len(named) else said


def cut(text: str, most: int) -> str:
    """A text of so many letters, its end left out where it is longer."""
    return text if len(text) <= most else f"{text[: most - 1]}…"
