"""Segment a stream into touches: frame by frame, or a whole recording at once, with the same result.

A touch is where the greatest change P(t) = max_e x_e exceeds a level; where it does not for less than 100 ms, it
continues. Frames with NaN or infinite values, and such as have the time of the one before, are counted, but not used.
Where no frame came for so long that a touch might have ended in between, it is cut off there.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, describe, is_number
from jeit.touch.gestures.change_course import ChangeCourse, TouchLevel, check_images, check_seconds

# Seconds untouched that separate two touches; the least number of frames of a touch; rounding of times.
_GAP, _LEAST, _ROUNDING = 0.1, 2, 1e-9


class StreamTouch(eqx.Module):
    """One touch of a stream: its `course`, from the first to the last frame above the level.

    `lost`: how many frames in it were not usable. `begun_before` and `cut_off`: whether it was there in the first
    frame, or the last, of an uninterrupted part of the stream, so that its true onset, or its end, is not known.
    """

    course: ChangeCourse
    lost: int = 0
    begun_before: bool = False
    cut_off: bool = False

    @property
    def onset(self) -> float:
        """Time of the first frame, seconds."""
        return float(self.course.seconds[0])

    @property
    def offset(self) -> float:
        """Time of the last frame, seconds."""
        return float(self.course.seconds[-1])

    @property
    def longest_gap(self) -> float:
        """The longest time between two of its frames, seconds; 0 for one frame."""
        return float(np.diff(self.course.seconds).max(initial=0.0))

    @property
    def whole(self) -> bool:
        """Whether both its onset and its end were seen."""
        return not (self.begun_before or self.cut_off)


class TouchStream(eqx.Module):
    """A stream up to now. `stream.follow(second, image)` returns the stream after the next frame; this one is not
    changed.

    A touch has ended once its last frame above the level is `gap` seconds past; it has `least` frames, shorter ones are
    not reported. A stream whose frames are `gap` apart, or more, has only touches that are cut off: give a greater one.

    **Fields**: `level`; `gap`; `least`; `second` of the last usable frame, -inf before the first; `open`, the frames of
    the touch that continues, of which so many are `held`, up to its last one above the level; how many frames were
    `lost` up to that, and since; `begun_before`, of that touch; `ended` touches.
    """

    level: TouchLevel
    gap: float = _GAP
    least: int = _LEAST
    second: float = -np.inf
    open: tuple[ChangeCourse, ...] = ()
    held: int = 0
    lost: tuple[int, int] = (0, 0)
    begun_before: bool = False
    ended: tuple[StreamTouch, ...] = ()

    def __check_init__(self):
        """Raises `ValueError` for what is no level, gap or number of frames."""
        _check(self.level, self.gap, self.least)

    def follow(self, second: float, image: Float[np.ndarray, " m"]) -> "TouchStream":
        """Return the stream after a frame (m,) at `second`. Raises `ValueError` for a time before the last one, and
        images of another mesh."""
        if not (is_number(second) and second >= self.second):
            raise ValueError(f"second must not be before the last frame, {self.second:g} s; it is {describe(second)}.")
        frame = check_images(np.asarray(image)[None], len(self.level.areas))
        if second == self.second or not np.isfinite(frame).all():
            return replace(self, lost=(self.lost[0], self.lost[1] + 1)) if self.open else self
        course = self.level.course(np.array([float(second)]), frame)
        after, unseen = self, second - self.second >= self.gap - _ROUNDING
        if self.open and second - self.open[self.held - 1].seconds[0] >= self.gap - _ROUNDING:
            after = replace(self, ended=(*self.ended, *self._going()), open=(), held=0, lost=(0, 0))
        above = bool(course.peak[0] > self.level.level)
        if above and not after.open:
            after = replace(after, begun_before=bool(unseen))
        if above or after.open:
            after = replace(after, open=(*after.open, course))
        if above:
            after = replace(after, held=len(after.open), lost=(sum(after.lost), 0))
        return replace(after, second=float(second))

    @property
    def touches(self) -> list[StreamTouch]:
        """All touches so far, including the one that continues, in order of onset."""
        return [*self.ended, *self._going()]

    def _going(self) -> tuple[StreamTouch, ...]:
        if self.held < self.least:
            return ()
        # Where the last frame seen is one of the touch's, it may have continued after that.
        cut_off = self.held == len(self.open)
        course = ChangeCourse.joined(list(self.open[: self.held]))
        return (StreamTouch(course, self.lost[0], self.begun_before, cut_off),)


def find_touches(
    level: TouchLevel,
    seconds: Float[np.ndarray, " F"],
    images: Float[np.ndarray, "F m"],
    *,
    gap: float = _GAP,
    least: int = _LEAST,
) -> list[StreamTouch]:
    """Find the touches of a recording, images (F, m) at times `seconds` (F,), as a `TouchStream` that follows it does.

    Raises `ValueError` for times that fall or are not finite, images of another mesh, and frames that mostly are as far
    apart as the `gap` that separates touches.
    """
    _check(level, gap, least)
    images = check_images(images, len(level.areas))
    seconds = check_seconds(seconds, len(images))
    finite = np.flatnonzero(np.isfinite(images).all(axis=1))
    used = finite[np.diff(seconds[finite], prepend=-np.inf) > 0]
    passed = np.diff(seconds[used])
    if passed.size and np.median(passed) >= gap - _ROUNDING:
        raise ValueError(
            f"gap is {gap:g} s, and frames are {np.median(passed):.3g} s apart: no touch lasts for two of them. Give a "
            "greater gap."
        )
    course = level.course(seconds[used], images[used])
    unseen = np.concatenate([[True], passed >= gap - _ROUNDING, [True]])
    above = np.flatnonzero(course.peak > level.level)
    parts = np.split(above, 1 + np.flatnonzero(np.diff(course.seconds[above]) >= gap - _ROUNDING))
    found = []
    for part in parts:
        if not part.size or part[-1] - part[0] + 1 < least:
            continue
        first, last = part[0], part[-1]
        lost = int(used[last] - used[first] - (last - first))
        own = course.of_frames(slice(first, last + 1))
        found.append(StreamTouch(own, lost, bool(unseen[first]), bool(unseen[last + 1])))
    return found


def _check(level, gap, least) -> None:
    check_kind("level", level, TouchLevel, "a TouchLevel, such as TouchLevel.of_untouched(mesh, images)")
    if not (is_number(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {describe(gap)}.")
    if not (isinstance(least, int) and least >= 1):
        raise ValueError(f"least must be a number of frames, 1 or more; it is {describe(least)}.")
