"""Frames in a table whose arrangement is found out: rows or columns, a column of times, frames wrapped over lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Inexact

from jeit.arguments import counted
from jeit.data.description import TableLayout
from jeit.data.formats.text import Text, rectangle

# Whole numbers that rise by as much as this may be milliseconds as well as seconds.
_STEP = 5


class Frames(NamedTuple):
    """**Fields**: `table`: frames in rows; `times`: of the rows, seconds, if a column has them; `notes`: what was found
    out."""

    table: Inexact[np.ndarray, "F M"]
    times: Float[np.ndarray, " F"] | None = None
    notes: tuple[str, ...] = ()


def frames_in_text(text: Text, counts: Sequence[int], layout: TableLayout, name: str) -> Frames:
    """Frames of a text file. `counts`: numbers of channels that a frame may have, the described one first.

    A last line or frame that is cut off is left out. Raises `ValueError` for lines of unequal length that are not
    frames wrapped over several lines.
    """
    if layout.frames_in is None and (wrapped := _wrapped(text, counts)) is not None:
        count, left = wrapped
        whole = len(text.values) // count
        notes = (f"each frame is wrapped over lines: {counted(count, 'number')} are a frame.", *_cut(left))
        return Frames(text.values[: whole * count].reshape(whole, count), None, (*text.notes, *notes))
    text = without_cut_line(text)
    found = frames_in_table(rectangle(text, name), counts, layout, text.heading)
    return found._replace(notes=(*text.notes, *found.notes))


def without_cut_line(text: Text) -> Text:
    """The text without a last line that is shorter than the first, for it is cut off; with a note about it."""
    if len(text.lengths) < 2 or text.lengths[-1] >= text.lengths[0]:
        return text
    last = int(text.lengths[-1])
    values = text.values[: len(text.values) - last]
    return text._replace(values=values, lengths=text.lengths[:-1], notes=(*text.notes, *_cut(last)))


def _wrapped(text: Text, counts: Sequence[int]) -> tuple[int, int] | None:
    """Numbers in a frame that is wrapped over several lines, and those left over at the end; None if lines or columns
    are frames."""
    ends = np.cumsum(text.lengths)
    if (text.lengths == text.lengths[0]).all():
        shape = len(text.lengths), int(text.lengths[0])
        if any(count in shape or count + 1 in shape for count in counts):
            return None
    fitting = []
    for count in counts:
        whole = int(ends[-1]) // count
        if whole and text.lengths[0] < count and np.isin(count * np.arange(1, whole + 1), ends).all():
            fitting.append((count, int(ends[-1]) - whole * count))
    return min(fitting, key=lambda one: one[1] > 0, default=None)  # rather one without a rest


def _cut(left: int) -> tuple[str, ...]:
    return (f"the last line is cut off after {counted(left, 'number')}, and left out.",) if left else ()


def frames_in_table(
    table: Inexact[np.ndarray, "R C"],
    counts: Sequence[int],
    layout: TableLayout,
    heading: Sequence[str] = (),
    usual: str = "rows",
) -> Frames:
    """Frames of an array. `counts` as for `frames_in_text`; `heading`: names of the columns; `usual`: where frames are
    if the numbers of channels do not decide, "rows" or "columns"."""
    stated = layout.frames_in
    turned = stated == "columns" if stated else _are_columns(table.shape, counts, usual)
    rows = table.T if turned else table
    notes: tuple[str, ...] = ()
    if stated is None and turned and usual == "rows":
        notes = ("frames are taken from its columns.",)
    if stated is None and not turned and usual == "columns" and min(table.shape) > 1:
        notes = ("frames are taken from its rows.",)
    times = None
    if rows.shape[1] - 1 in counts and rows.shape[1] not in counts and layout.time_column is not False:
        times, said = _times(np.real(rows[:, 0]), "" if turned or not heading else heading[0])
        rows, notes = (rows[:, 1:], (*notes, said)) if said else (rows, notes)
    return Frames(rows, times, notes)


def _are_columns(shape: tuple[int, int], counts: Sequence[int], usual: str) -> bool:
    """Whether columns, not rows, are frames: the first number of channels that one of the two has decides."""
    for more in (0, 1):
        for count in counts:
            fits = [shape[1] == count + more, shape[0] == count + more]
            if any(fits):
                return fits[1] and (usual == "columns" or not fits[0])
    return usual == "columns"


def _times(column: Float[np.ndarray, " F"], named: str) -> tuple[Float[np.ndarray, " F"] | None, str]:
    """Times in seconds from the first number of each frame, and a note; no note if these do not rise."""
    if not (np.isfinite(column).all() and (np.diff(column) > 0).all()):
        return None, ""
    if (column == column[0] + np.arange(len(column))).all():
        return None, "the first number of each frame counts frames, and is left out."
    if not named and (column == np.round(column)).all() and np.median(np.diff(column)) >= _STEP:
        step = float(np.median(np.diff(column)))
        return None, f"the first number of each frame rises by {step:g}; its unit is not known, and it is left out."
    unit = 1e-3 if "ms" in named.lower() else 1e-6 if "us" in named.lower() or "µs" in named.lower() else 1.0
    said = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds"}[unit]
    return unit * column, f"the first number of each frame is taken for its time, in {said}."
