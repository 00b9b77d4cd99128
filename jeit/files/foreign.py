"""What other packages raise on files that are damaged: one error of ours."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_LONGEST = 120


@contextmanager
def read_as(said: str) -> Iterator[None]:
    """Within it only other packages read: whatever they raise becomes a `ValueError`, `said` (such as "not a readable
    WAV file") with their reason in brackets; that there is no such file, or that it may not be read, stays as it is.

    What they print as warnings is not shown: a file that is read is as it should be.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except Exception as error:  # of any kind: packages that read formats raise what they stumble over
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            raise
        raise ValueError(f"{said} ({reason(error)}).") from None


def reason(error: Exception) -> str:
    """What an error says, in one short line: its kind where it says nothing."""
    text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
