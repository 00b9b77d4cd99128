"""Progress of work in chunks, and estimate of the remaining time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple


class Progress(NamedTuple):
    """Progress of a study: finished and total points and chunks; `seconds_left`, None until the first point of this
    run.

    With exact maps, `points` also counts those of a chunk that is not finished, and would be solved again.
    """

    points: int
    all_points: int
    chunks: int
    all_chunks: int
    seconds_left: float | None


class ProgressReporter:
    """Calls `progress` for work in `chunks`, and estimates the remaining time from the points finished since its
    creation; `done` were finished before."""

    def __init__(self, chunks: Sequence[Sequence[int]], done: set[int], progress: Callable[[Progress], None] | None):
        self._chunks, self._done, self._progress = chunks, set(done), progress
        self._all = sum(len(chunk) for chunk in chunks)
        self._first, self._start = self._points(), time.monotonic()
        self._report(self._first, None)

    def finished(self, number: int) -> None:
        """Report a finished chunk."""
        self._done.add(number)
        self._reckon(self._points())

    def solved(self, points: int) -> None:
        """Report the number of finished points of the current chunk."""
        self._reckon(self._points() + points)

    def _reckon(self, points: int) -> None:
        pace = (time.monotonic() - self._start) / (points - self._first)
        self._report(points, pace * (self._all - points))

    def _points(self) -> int:
        return sum(len(self._chunks[number]) for number in self._done)

    def _report(self, points: int, seconds_left: float | None) -> None:
        if self._progress is not None:
            self._progress(Progress(points, self._all, len(self._done), len(self._chunks), seconds_left))
