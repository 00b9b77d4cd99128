"""Segment a stream of images into touches, and compute the time course of the change of conductivity.

A touch lasts while the maximum change P(t) = max_e x_e over the mesh elements e exceeds a level; interruptions shorter
than 100 ms are bridged. Frames with NaN or infinite values, and frames with the same time as the frame before, are
counted but not used. If no frame arrives for so long that a touch may have ended in the meantime, the touch is cut off
at its last frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, describe, is_number, real_array
from jeit.mesh import Mesh, centroids, check_flat, measures
from jeit_solvers.module import Module

# Minimum number of untouched frames for estimating the standard deviation of their peaks.
_MIN_UNTOUCHED_FRAMES = 10
# Number of standard deviations by which the touch level exceeds the mean peak of untouched frames.
_TOUCH_LEVEL_DEVIATIONS = 5.0


class ChangeCourse(Module):
    """Time course of T images of the change x_e of mesh elements e, in the unit of the images.

    **Fields**: `seconds` (T,): times; `peak` (T,): P = max_e x_e; `least` (T,): min_e x_e; `half_share` (T,): fraction
    of the elements with x_e ≥ P / 2; `mean` (T,): mean of x_e over the elements above the touch level, 0 without such
    elements; `area` (T,): area of the elements above the level, m²; `centroid` (T, 2): their centroid, metres, weighted
    by area and by the excess above the level, NaN without such elements.
    """

    seconds: Float[np.ndarray, " T"]
    peak: Float[np.ndarray, " T"]
    least: Float[np.ndarray, " T"]
    half_share: Float[np.ndarray, " T"]
    mean: Float[np.ndarray, " T"]
    area: Float[np.ndarray, " T"]
    centroid: Float[np.ndarray, "T 2"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.seconds)

    def select(self, frames: slice | np.ndarray) -> "ChangeCourse":
        """Return the time course of the frames that are selected by a slice or an array of indices."""
        return ChangeCourse(*(getattr(self, field_name)[frames] for field_name in _FIELD_NAMES))

    @classmethod
    def concatenate(cls, time_courses: "list[ChangeCourse]") -> "ChangeCourse":
        """Concatenate time courses; an empty list gives a time course without frames."""
        empty_arrays = {field_name: np.empty((0, 2) if field_name == "centroid" else 0) for field_name in _FIELD_NAMES}
        field_arrays = {
            field_name: [empty_arrays[field_name], *(getattr(time_course, field_name) for time_course in time_courses)]
            for field_name in _FIELD_NAMES
        }
        return cls(*(np.concatenate(field_arrays[field_name]) for field_name in _FIELD_NAMES))


_FIELD_NAMES = ("seconds", "peak", "least", "half_share", "mean", "area", "centroid")


class TouchLevel(Module):
    """Threshold of touch: the skin is touched while the maximum change in its image exceeds this level.

    **Arguments:**

    - `mesh`: mesh of the images.
    - `level`: the level, in the unit of the images.

    **Fields**: `level`; `centres` (m, 2): centroids of the mesh's elements, metres; `areas` (m,): areas of the
    elements, m².

    **Example:**

    ```python
    level = TouchLevel.of_untouched(images.mesh, images.changes(empty))
    touches = find_touches(level, seconds, images.changes(film))
    ```
    """

    level: float
    centres: Float[np.ndarray, "m 2"]
    areas: Float[np.ndarray, " m"]

    def __init__(self, mesh: Mesh, level: float):
        """Set the level for images on a flat 2-D mesh.

        Raises `ValueError` for a mesh that is not flat and 2-D, and for a level that is not positive.
        """
        check_kind("mesh", mesh, Mesh, "a Mesh, that of the images")
        check_flat(mesh, "gestures")
        if mesh.dimension != 2:
            raise ValueError("mesh must be of two dimensions, a sheet's.")
        if not (is_number(level) and level > 0):
            raise ValueError(f"level must be positive, in the images' unit; it is {describe(level)}.")
        self.level = float(level)
        self.centres, self.areas = np.asarray(centroids(mesh)), np.asarray(measures(mesh))

    @classmethod
    def of_untouched(cls, mesh: Mesh, images: Float[np.ndarray, "F m"]) -> "TouchLevel":
        """Estimate the level from at least ten images (F, m) of an untouched skin.

        The level is five standard deviations above the mean of the maxima of the images; images with NaN are left out.
        The level allows for drift only if the images span as long a time as later recordings. Raises `ValueError` for
        fewer than ten images, images on a different mesh, and images that are all the same.
        """
        check_kind("mesh", mesh, Mesh, "a Mesh, that of the images")
        images = check_images(images, mesh.num_cells)
        frame_peaks = images[np.isfinite(images).all(axis=1)].max(axis=1, initial=-np.inf)
        if len(frame_peaks) < _MIN_UNTOUCHED_FRAMES:
            raise ValueError(
                f"images: give {_MIN_UNTOUCHED_FRAMES} frames of an untouched skin, or more; {len(frame_peaks)} "
                "have none."
            )
        if np.ptp(frame_peaks) == 0:
            raise ValueError("images are all the same and show no noise. Give what was read, not copies of a frame.")
        return cls(mesh, float(frame_peaks.mean() + _TOUCH_LEVEL_DEVIATIONS * frame_peaks.std(ddof=1)))

    def course(self, seconds: Float[np.ndarray, " F"], images: Float[np.ndarray, "F m"]) -> ChangeCourse:
        """Compute the time course of images (F, m) at times `seconds` (F,).

        Raises `ValueError` for images on a different mesh, values that are not finite, and more or fewer times than
        images.
        """
        images = check_images(images, len(self.areas))
        seconds = check_seconds(seconds, len(images))
        if not np.isfinite(images).all():
            raise ValueError("images have NaN or infinite values; leave out those frames, as `find_touches` does.")
        frame_peaks = images.max(axis=1, initial=-np.inf)
        is_above_level = images > self.level
        num_elements_above = np.maximum(is_above_level.sum(axis=1), 1)
        cell_weights = self.areas * np.where(is_above_level, images - self.level, 0.0)
        total_weight = cell_weights.sum(axis=1, keepdims=True)
        frame_centroids = cell_weights @ self.centres / np.where(total_weight > 0, total_weight, np.nan)
        return ChangeCourse(
            seconds=seconds,
            peak=frame_peaks,
            least=images.min(axis=1, initial=np.inf),
            half_share=np.mean(images >= frame_peaks[:, None] / 2, axis=1),
            mean=np.where(is_above_level, images, 0.0).sum(axis=1) / num_elements_above,
            area=is_above_level @ self.areas,
            centroid=frame_centroids,
        )


def check_images(images: Float[np.ndarray, "F m"], num_elements: int) -> Float[np.ndarray, "F m"]:
    """Convert images on a mesh of `num_elements` elements to an array (F, m). Raises `ValueError` for other shapes."""
    images = real_array("images", images, f"images of change (F, {num_elements}), a row a frame")
    if images.ndim != 2 or images.shape[1] != num_elements:
        raise ValueError(
            f"images have shape {images.shape}; give (F, {num_elements}), a row a frame, of the mesh's elements."
        )
    return images


def check_seconds(seconds: Float[np.ndarray, " F"], num_frames: int) -> Float[np.ndarray, " F"]:
    """Convert the times of `num_frames` frames to an array (F,).

    Raises `ValueError` if the number of times is not `num_frames`, or if times decrease or are not finite.
    """
    seconds = real_array("seconds", seconds, f"times ({num_frames},) of the frames")
    if seconds.shape != (num_frames,):
        raise ValueError(f"seconds have shape {seconds.shape}; give one for each of the {num_frames} frames.")
    if not np.isfinite(seconds).all() or (np.diff(seconds) < 0).any():
        raise ValueError("seconds must be finite, and must not fall: sort frames by time.")
    return seconds


# Minimum untouched time between two touches, seconds.
_MIN_GAP = 0.1
# Minimum number of frames of a touch.
_MIN_TOUCH_FRAMES = 2
# Tolerance for rounding of times, seconds.
_TIME_TOLERANCE = 1e-9


class StreamTouch(Module):
    """One touch in a stream of images.

    **Fields**: `course`: time course of the touch, from the first to the last frame above the touch level; `lost`:
    number of unusable frames between these frames; `begun_before`: whether the touch is present in the first frame of
    an uninterrupted part of the stream, so that its onset is unknown; `cut_off`: whether it is present in the last
    frame of such a part, so that its end is unknown.

    **Example:**

    ```python
    for touch in find_touches(level, seconds, images.changes(film)):
        print(isinstance(touch, StreamTouch), touch.onset, touch.offset)
    ```
    """

    course: ChangeCourse
    lost: int = 0
    begun_before: bool = False
    cut_off: bool = False

    @property
    def onset(self) -> float:
        """Time of the first frame of the touch, seconds."""
        return float(self.course.seconds[0])

    @property
    def offset(self) -> float:
        """Time of the last frame of the touch, seconds."""
        return float(self.course.seconds[-1])

    @property
    def longest_gap(self) -> float:
        """Maximum time between two consecutive frames of the touch, seconds; 0 for a single frame."""
        return float(np.diff(self.course.seconds).max(initial=0.0))

    @property
    def whole(self) -> bool:
        """Whether both the onset and the end of the touch were recorded."""
        return not (self.begun_before or self.cut_off)


class TouchStream(Module):
    """State of the segmentation of a stream of images into touches.

    `stream.follow(second, image)` returns the state after the next frame; `stream` is not changed. A touch has ended
    when `gap` seconds have passed since its last frame above the level. Touches of fewer than `least` frames are
    discarded. If frames are `gap` or more seconds apart, every touch is cut off after one frame: choose a larger `gap`.

    **Fields**: `level`: level of a touch; `gap`: minimum untouched time between two touches, seconds; `least`: minimum
    number of frames of a touch; `second`: time of the last usable frame, -inf before the first; `open`: frames of the
    current touch; `held`: number of these frames up to the last frame above the level; `lost`: numbers of unusable
    frames before and after the last frame above the level; `begun_before`: whether the current touch began before it
    was first seen; `ended`: touches that have ended.

    **Example:**

    ```python
    stream = TouchStream(level, gap=0.2)
    for second, change in zip(seconds, images.changes(film), strict=True):
        stream = stream.follow(second, change)
    ```
    """

    level: TouchLevel
    gap: float = _MIN_GAP
    least: int = _MIN_TOUCH_FRAMES
    second: float = -np.inf
    open: tuple[ChangeCourse, ...] = ()
    held: int = 0
    lost: tuple[int, int] = (0, 0)
    begun_before: bool = False
    ended: tuple[StreamTouch, ...] = ()

    def __check_init__(self):
        """Check the fields. Raises `ValueError` for an invalid level, gap or number of frames."""
        _check_touch_settings(self.level, self.gap, self.least)

    def follow(self, second: float, image: Float[np.ndarray, " m"]) -> "TouchStream":
        """Return the state of the segmentation after an image (m,) at time `second`, seconds.

        Raises `ValueError` for a time before that of the last frame, and an image on a different mesh.
        """
        if not (is_number(second) and second >= self.second):
            raise ValueError(f"second must not be before the last frame, {self.second:g} s; it is {describe(second)}.")
        current_frame = check_images(np.asarray(image)[None], len(self.level.areas))
        if second == self.second or not np.isfinite(current_frame).all():
            return replace(self, lost=(self.lost[0], self.lost[1] + 1)) if self.open else self
        time_course = self.level.course(np.array([float(second)]), current_frame)
        new_state, is_after_gap = self, second - self.second >= self.gap - _TIME_TOLERANCE
        if self.open and second - self.open[self.held - 1].seconds[0] >= self.gap - _TIME_TOLERANCE:
            new_state = replace(self, ended=(*self.ended, *self._current_touch()), open=(), held=0, lost=(0, 0))
        is_above_level = bool(time_course.peak[0] > self.level.level)
        if is_above_level and not new_state.open:
            new_state = replace(new_state, begun_before=bool(is_after_gap))
        if is_above_level or new_state.open:
            new_state = replace(new_state, open=(*new_state.open, time_course))
        if is_above_level:
            new_state = replace(new_state, held=len(new_state.open), lost=(sum(new_state.lost), 0))
        return replace(new_state, second=float(second))

    @property
    def touches(self) -> list[StreamTouch]:
        """All touches so far, including the current one, in order of onset."""
        return [*self.ended, *self._current_touch()]

    def _current_touch(self) -> tuple[StreamTouch, ...]:
        if self.held < self.least:
            return ()
        # If the last frame is above the level, the touch may have continued after it.
        is_cut_off = self.held == len(self.open)
        time_course = ChangeCourse.concatenate(list(self.open[: self.held]))
        return (StreamTouch(time_course, self.lost[0], self.begun_before, is_cut_off),)


def find_touches(
    level: TouchLevel,
    seconds: Float[np.ndarray, " F"],
    images: Float[np.ndarray, "F m"],
    *,
    gap: float = _MIN_GAP,
    least: int = _MIN_TOUCH_FRAMES,
) -> list[StreamTouch]:
    """Find the touches in a series of images at once; a `TouchStream` finds them image by image.

    **Arguments:**

    - `level`: level above which the skin is touched.
    - `seconds`: times (F,) of the images, seconds.
    - `images`: images of change (F, m), in the unit of the level.
    - `gap`: minimum untouched time between two touches, seconds.
    - `least`: minimum number of frames of a touch.

    Raises `ValueError` for times that decrease or are not finite, images on a different mesh, and images whose median
    interval is not below `gap`.

    **Example:**

    ```python
    touches = find_touches(level, seconds, images.changes(film), gap=0.2)
    print([(touch.onset, touch.offset) for touch in touches])
    ```
    """
    _check_touch_settings(level, gap, least)
    images = check_images(images, len(level.areas))
    seconds = check_seconds(seconds, len(images))
    finite_frames = np.flatnonzero(np.isfinite(images).all(axis=1))
    used_frames = finite_frames[np.diff(seconds[finite_frames], prepend=-np.inf) > 0]
    frame_intervals = np.diff(seconds[used_frames])
    if frame_intervals.size and np.median(frame_intervals) >= gap - _TIME_TOLERANCE:
        raise ValueError(
            f"gap is {gap:g} s, and frames are {np.median(frame_intervals):.3g} s apart: no touch lasts for two of "
            "them. Give a greater gap."
        )
    time_course = level.course(seconds[used_frames], images[used_frames])
    is_after_gap = np.concatenate([[True], frame_intervals >= gap - _TIME_TOLERANCE, [True]])
    frames_above_level = np.flatnonzero(time_course.peak > level.level)
    frames_of_touches = np.split(
        frames_above_level,
        1 + np.flatnonzero(np.diff(time_course.seconds[frames_above_level]) >= gap - _TIME_TOLERANCE),
    )
    touches = []
    for touch_frames in frames_of_touches:
        if not touch_frames.size or touch_frames[-1] - touch_frames[0] + 1 < least:
            continue
        first_frame, last_frame = touch_frames[0], touch_frames[-1]
        num_lost = int(used_frames[last_frame] - used_frames[first_frame] - (last_frame - first_frame))
        touch_course = time_course.select(slice(first_frame, last_frame + 1))
        touches.append(
            StreamTouch(touch_course, num_lost, bool(is_after_gap[first_frame]), bool(is_after_gap[last_frame + 1]))
        )
    return touches


def _check_touch_settings(level, gap, least) -> None:
    check_kind("level", level, TouchLevel, "a TouchLevel, such as TouchLevel.of_untouched(mesh, images)")
    if not (is_number(gap) and gap > 0):
        raise ValueError(f"gap must be positive, in seconds; it is {describe(gap)}.")
    if not (isinstance(least, int) and least >= 1):
        raise ValueError(f"least must be a number of frames, 1 or more; it is {describe(least)}.")
