"""Frames from standard input, with their times from a given rate or from the clock."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

# Minimum waiting time for a frame to count as live, as a share of the usual interval between frames; number of
# consecutive live frames after which earlier frames are taken to be read; and maximum time for reading earlier frames,
# in seconds.
_WAITED, _IN_A_ROW, _BEFORE = 0.4, 3, 5.0


class LiveFrames:
    """Iterator of pairs (time in seconds, frame) over `lines`, the frames that `parse_frames` returns.

    With a `rate`, in frames/s, all frames are used. Without it, times come from the clock, and frames that arrived
    before reading began are skipped and counted in `left_out`. If all frames have already arrived, such as from a file,
    none is skipped, and the `usual` rate is used.
    """

    def __init__(self, lines: Iterator[object], rate: float | None, usual: float):
        self.lines, self.rate, self.usual = lines, rate, usual
        self.by_clock, self.left_out = rate is None, 0
        self.read: list[tuple[float, object]] = []
        self.begun, self.number = 0.0, 0

    @property
    def rate_seen(self) -> float:
        """Frame rate in frames/s: the given rate, the mean rate of the frames read, or the usual rate."""
        if self.rate is not None:
            return self.rate
        seconds = [second for second, _ in self.read]
        return (len(seconds) - 1) / seconds[-1] if len(seconds) > 1 and seconds[-1] > 0 else self.usual

    def untouched(self, span: float) -> Float[np.ndarray, "u M"]:
        """Read the frames of the first `span` seconds; iteration returns them again. Raises `ValueError` if there are
        none."""
        self._catch_up()
        while not self.read or self.read[-1][0] < span:
            frame = self._next()
            if frame is None:
                break
            self.read.append((self._second(), frame))
        rows = [frame for second, frame in self.read if isinstance(frame, list) and second <= span]
        if not rows:
            raise ValueError("standard input: there was no frame of numbers in it.")
        widths = [len(one) for one in rows]
        usual = max(set(widths), key=widths.count)
        return np.array([one for one in rows if len(one) == usual])

    def __iter__(self) -> Iterator[tuple[float, object]]:
        self._catch_up()
        yield from self.read
        while (frame := self._next()) is not None:
            yield self._second(), frame

    def _catch_up(self) -> None:
        """Skip frames that arrived before reading began. If the input ends with them, keep them and use a rate."""
        if not self.by_clock:
            return
        before, in_a_row, start = [], 0, time.monotonic()
        while time.monotonic() - start < _BEFORE:
            asked = time.monotonic()
            frame = self._next()
            if frame is None:
                self.rate = self.rate_seen
                self.number = len(self.read)
                self.by_clock = False
                self.read += [(self._second(), one) for one in before]
                return
            in_a_row = in_a_row + 1 if time.monotonic() - asked > _WAITED / self.usual else 0
            if in_a_row == _IN_A_ROW:
                self.left_out += len(before)
                self.read.append((self._second(), frame))
                return
            before.append(frame)
        self.left_out += len(before)

    def _second(self) -> float:
        now = time.monotonic()
        self.begun = now if self.number == 0 else self.begun
        second = now - self.begun if self.by_clock else self.number / self.rate_seen
        self.number += 1
        return max(second, self.read[-1][0] if self.read else 0.0)

    def _next(self) -> object | None:
        """Wait for the next frame; None after the last."""
        return next(self.lines, None)
