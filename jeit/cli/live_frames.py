"""Frames from standard input, with their times from a given frame rate or from the clock."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

# Minimum waiting time for a frame to count as live, as a fraction of the usual interval between frames; number of
# consecutive live frames after which all earlier frames are considered read; and maximum time for reading earlier
# frames, in seconds.
_MIN_WAIT_SHARE, _NUM_LIVE_FRAMES, _MAX_CATCH_UP_SECONDS = 0.4, 3, 5.0


class LiveFrames:
    """Iterator of pairs (time in seconds, frame) over `lines`, the frames that `parse_frames` returns.

    With a `rate`, in frames/s, all frames are used. Without a `rate`, times come from the clock, and frames that
    arrived before reading began are skipped and counted in `left_out`. If all frames have already arrived, e.g. from a
    file, no frame is skipped, and times follow from the `usual_rate`.
    """

    def __init__(self, lines: Iterator[object], rate: float | None, usual_rate: float):
        self.lines, self.rate, self.usual_rate = lines, rate, usual_rate
        self.by_clock, self.left_out = rate is None, 0
        self.read_frames: list[tuple[float, object]] = []
        self.first_time, self.num_returned = 0.0, 0

    @property
    def rate_seen(self) -> float:
        """Frame rate in frames/s: the given rate, else the mean rate of the frames read, else the usual rate."""
        if self.rate is not None:
            return self.rate
        seconds = [second for second, _ in self.read_frames]
        return (len(seconds) - 1) / seconds[-1] if len(seconds) > 1 and seconds[-1] > 0 else self.usual_rate

    def untouched(self, span: float) -> Float[np.ndarray, "u M"]:
        """Read the frames (frames, channels) of the first `span` seconds; iteration returns these frames again. Raises
        `ValueError` if there are none."""
        self._catch_up()
        while not self.read_frames or self.read_frames[-1][0] < span:
            frame = self._next()
            if frame is None:
                break
            self.read_frames.append((self._second(), frame))
        rows = [frame for second, frame in self.read_frames if isinstance(frame, list) and second <= span]
        if not rows:
            raise ValueError("standard input: there was no frame of numbers in it.")
        frame_lengths = [len(row) for row in rows]
        usual_width = max(set(frame_lengths), key=frame_lengths.count)
        return np.array([row for row in rows if len(row) == usual_width])

    def __iter__(self) -> Iterator[tuple[float, object]]:
        self._catch_up()
        yield from self.read_frames
        while (frame := self._next()) is not None:
            yield self._second(), frame

    def _catch_up(self) -> None:
        """Skip frames that arrived before reading began. If the input ends with these frames, keep them, with times
        from the usual rate."""
        if not self.by_clock:
            return
        skipped_frames, num_consecutive, start = [], 0, time.monotonic()
        while time.monotonic() - start < _MAX_CATCH_UP_SECONDS:
            wait_start = time.monotonic()
            frame = self._next()
            if frame is None:
                self.rate = self.rate_seen
                self.num_returned = len(self.read_frames)
                self.by_clock = False
                self.read_frames += [(self._second(), skipped) for skipped in skipped_frames]
                return
            num_consecutive = (
                num_consecutive + 1 if time.monotonic() - wait_start > _MIN_WAIT_SHARE / self.usual_rate else 0
            )
            if num_consecutive == _NUM_LIVE_FRAMES:
                self.left_out += len(skipped_frames)
                self.read_frames.append((self._second(), frame))
                return
            skipped_frames.append(frame)
        self.left_out += len(skipped_frames)

    def _second(self) -> float:
        now = time.monotonic()
        self.first_time = now if self.num_returned == 0 else self.first_time
        second = now - self.first_time if self.by_clock else self.num_returned / self.rate_seen
        self.num_returned += 1
        return max(second, self.read_frames[-1][0] if self.read_frames else 0.0)

    def _next(self) -> object | None:
        """Wait for the next frame, and return it; None after the last frame."""
        return next(self.lines, None)
