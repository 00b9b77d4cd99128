"""Features of touches: the seven features of Silvera Tawil et al. (2011), and features of a touch's time course."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.touch.gestures.segmentation import ChangeCourse, StreamTouch

# Unit of each feature; "image" stands for the unit of the images of change: siemens for a sheet, otherwise S/m.
FEATURES = {
    "greatest change": "image",
    "least change": "image",
    "share above half": "1",
    "mean in contact": "image",
    "duration": "s",
    "rate of change": "image/s",
    "displacement": "m",
}
"""Names of the seven features of a touch, and their units; "image" stands for the unit of the images."""

# Number of instants, evenly spaced from onset to end of a touch, at which the maximum change P is sampled.
_NUM_COURSE_INSTANTS = 16
_ADDITIONAL_FEATURES = (
    "area", "area spread", "path length", "farthest", "speed", "fastest", "straightness", "peaks", "rise", "decay",
    "roughness", "pauses", "centre of gravity", "breadth",
)  # fmt: skip
COURSE_FEATURES = (
    *FEATURES,
    *_ADDITIONAL_FEATURES,
    *(f"course {instant + 1}" for instant in range(_NUM_COURSE_INSTANTS)),
)
"""Names of the features of `course_features`: the seven features, further features of the time course, and samples of
P."""

NUM_SEQUENCE_INSTANTS = 32
SEQUENCE_VALUES = ("change", "share", "mean", "area", "half", "speed", "distance", "along")
"""Quantities that `sequence_features` samples at `NUM_SEQUENCE_INSTANTS` instants of a touch, from onset to end."""
SEQUENCE_FEATURES = (
    *COURSE_FEATURES, *(f"{name} {instant + 1}" for instant in range(NUM_SEQUENCE_INSTANTS) for name in SEQUENCE_VALUES)
)  # fmt: skip
"""Names of the features of `sequence_features`."""


@dataclass(frozen=True)
class TouchFeatures:
    """Features of n touches.

    **Fields**: `values` (n, k): values of k features, a row for each touch; `names`, `units`: names and units of the
    features.
    """

    values: Float[np.ndarray, "n k"]
    names: tuple[str, ...]
    units: tuple[str, ...]

    def __len__(self) -> int:
        """Number of touches."""
        return len(self.values)


def touch_features(touches: list[StreamTouch] | tuple[StreamTouch, ...]) -> TouchFeatures:
    """Compute the seven features of n touches by Silvera Tawil et al. (2011), table II and section IV-A.

    Let x_e be the change of conductivity of mesh element e, P(t) = max_e x_e the maximum change at time t, and t* the
    time of the maximum of P. The features, in the order of `FEATURES`, are: P at t*; minimum of x_e over all elements
    and frames of the touch; fraction of the elements with x_e ≥ P / 2 at t*; mean of x_e at t* over the elements above
    the touch level; duration from the first to the last frame above the level, s; mean of |dP/dt|, 0 for a single
    frame; distance between the first and the last centroid, m.

    **Arguments:**

    - `touches`: the touches, as from `find_touches`.

    Raises `ValueError` if `touches` is not a list of touches.

    **Example:**

    ```python
    features = touch_features(touches)
    print(features)
    ```
    """
    time_courses = _time_courses(touches)
    feature_values = np.array([_seven_features(time_course) for time_course in time_courses]).reshape(
        len(time_courses), len(FEATURES)
    )
    return TouchFeatures(feature_values, tuple(FEATURES), tuple(FEATURES.values()))


def course_features(touches: list[StreamTouch] | tuple[StreamTouch, ...]) -> TouchFeatures:
    """Compute the features `COURSE_FEATURES` of n touches: those of `touch_features`, and features of the time course.

    P(t) is the maximum change of conductivity over the skin at time t. The features of the time course are: mean of the
    contact area, and its standard deviation divided by the mean; length of the centroid's path, maximum distance of the
    centroid from its start, mean speed, 90 % quantile of the speed, and displacement divided by path length; number of
    peaks of P above half its maximum; time from onset to the maximum of P, and from this maximum to the end; total
    variation of P / max P; fraction of frames with P below half its maximum; mean and standard deviation of time,
    divided by the duration and weighted by P; P / max P at instants evenly spaced in time. Raises `ValueError` if
    `touches` is not a list of touches.
    """
    time_courses = _time_courses(touches)
    seven_features = touch_features(touches)
    feature_values = np.array([_additional_features(time_course) for time_course in time_courses]).reshape(
        len(time_courses), len(_ADDITIONAL_FEATURES) + _NUM_COURSE_INSTANTS
    )
    feature_units = (
        "m²",
        "1",
        "m",
        "m",
        "m/s",
        "m/s",
        "1",
        "1",
        "s",
        "s",
        "1",
        "1",
        "1",
        "1",
        *["1"] * _NUM_COURSE_INSTANTS,
    )
    return TouchFeatures(
        np.hstack([seven_features.values, feature_values]), COURSE_FEATURES, (*seven_features.units, *feature_units)
    )


def sequence_features(touches: list[StreamTouch] | tuple[StreamTouch, ...]) -> TouchFeatures:
    """Compute the features `SEQUENCE_FEATURES` of n touches: those of `course_features`, and a sampled time course.

    The following quantities are sampled at instants evenly spaced in time: P, the maximum change of conductivity over
    the skin; P / max P; mean change of the elements in contact; contact area; fraction of elements above half of P;
    speed of the centroid; distance of the centroid from its start; position of the centroid along its main direction of
    movement, with the sign that makes the largest displacement positive. Raises `ValueError` if `touches` is not a list
    of touches.
    """
    time_courses = _time_courses(touches)
    course_values = course_features(touches)
    num_columns = NUM_SEQUENCE_INSTANTS * len(SEQUENCE_VALUES)
    sampled_values = np.array([_sample_time_course(time_course).ravel() for time_course in time_courses]).reshape(
        len(time_courses), num_columns
    )
    sampled_units = ("image", "1", "image", "m²", "1", "m/s", "m", "m") * NUM_SEQUENCE_INSTANTS
    return TouchFeatures(
        np.hstack([course_values.values, sampled_values]), SEQUENCE_FEATURES, (*course_values.units, *sampled_units)
    )


def _time_courses(touches) -> list[ChangeCourse]:
    check_kind("touches", touches, (list, tuple), "a list of touches, such as of find_touches")
    for touch_index, touch in enumerate(touches):
        check_kind(f"touches[{touch_index}]", touch, StreamTouch, "a StreamTouch, such as of find_touches")
    return [touch.course for touch in touches]


def _seven_features(time_course: ChangeCourse) -> list[float]:
    """Compute the seven features of one touch from its time course, in the order of `FEATURES`."""
    peak_frame = int(time_course.peak.argmax())
    frame_intervals = np.diff(time_course.seconds)
    mean_rate_of_change = np.mean(np.abs(np.diff(time_course.peak)) / frame_intervals) if frame_intervals.size else 0.0
    return [
        time_course.peak[peak_frame],
        time_course.least.min(),
        time_course.half_share[peak_frame],
        time_course.mean[peak_frame],
        time_course.seconds[-1] - time_course.seconds[0],
        float(mean_rate_of_change),
        float(np.linalg.norm(time_course.centroid[-1] - time_course.centroid[0])),
    ]


def _additional_features(time_course: ChangeCourse) -> list[float]:
    """Compute the features of one touch that follow the first seven in `COURSE_FEATURES`, in this order."""
    has_centroid = np.isfinite(time_course.centroid[:, 0])  # a frame below the level has no centroid
    centroids, centroid_times = time_course.centroid[has_centroid], time_course.seconds[has_centroid]
    step_lengths = np.linalg.norm(np.diff(centroids, axis=0), axis=1)
    path_length, displacement = float(step_lengths.sum()), float(np.linalg.norm(centroids[-1] - centroids[0]))
    duration = max(time_course.seconds[-1] - time_course.seconds[0], 1e-9)
    centroid_speeds = step_lengths / np.diff(centroid_times) if step_lengths.size else np.zeros(1)
    relative_peaks = time_course.peak / time_course.peak.max()
    peak_frame = int(relative_peaks.argmax())
    relative_times = (time_course.seconds - time_course.seconds[0]) / duration
    peak_weights = relative_peaks / relative_peaks.sum()
    mean_time = float(peak_weights @ relative_times)
    peak_differences = np.diff(relative_peaks)
    peak_frames = np.flatnonzero((peak_differences[:-1] > 0) & (peak_differences[1:] <= 0)) + 1
    return [
        float(time_course.area[has_centroid].mean()),
        float(time_course.area[has_centroid].std() / time_course.area[has_centroid].mean()),
        path_length,
        float(np.linalg.norm(centroids - centroids[0], axis=1).max()),
        path_length / duration,
        float(np.quantile(centroid_speeds, 0.9)),
        displacement / max(path_length, 1e-9),
        float(max(np.count_nonzero(relative_peaks[peak_frames] > 0.5), 1)),
        float(time_course.seconds[peak_frame] - time_course.seconds[0]),
        float(time_course.seconds[-1] - time_course.seconds[peak_frame]),
        float(np.abs(peak_differences).sum()),
        float(np.mean(relative_peaks < 0.5)),
        mean_time,
        float(np.sqrt(peak_weights @ (relative_times - mean_time) ** 2)),
        *np.interp(np.linspace(0, 1, _NUM_COURSE_INSTANTS), relative_times, relative_peaks),
    ]


def _sample_time_course(time_course: ChangeCourse) -> Float[np.ndarray, "T c"]:
    """Sample the quantities `SEQUENCE_VALUES` at `NUM_SEQUENCE_INSTANTS` instants of a touch."""
    frame_times = time_course.seconds
    sample_times = np.linspace(frame_times[0], frame_times[-1], NUM_SEQUENCE_INSTANTS)
    has_centroid = np.isfinite(time_course.centroid[:, 0])  # a frame below the level has no centroid
    centroids = np.stack(
        [
            np.interp(sample_times, frame_times[has_centroid], centroid_coordinate[has_centroid])
            for centroid_coordinate in time_course.centroid.T
        ],
        axis=1,
    )
    step_lengths = np.linalg.norm(np.diff(centroids, axis=0, prepend=centroids[:1]), axis=1)
    centroid_speed = step_lengths / max((frame_times[-1] - frame_times[0]) / (NUM_SEQUENCE_INSTANTS - 1), 1e-9)
    centred_path = centroids - centroids.mean(axis=0)
    positions_on_axis = centred_path @ np.linalg.svd(centred_path, full_matrices=False)[2][0]
    positions_on_axis = positions_on_axis - positions_on_axis[0]
    largest_displacement = positions_on_axis[np.abs(positions_on_axis).argmax()]
    peak_change, mean_change, contact_area, half_peak_share = (
        np.interp(sample_times, frame_times, course_values)
        for course_values in (time_course.peak, time_course.mean, time_course.area, time_course.half_share)
    )
    distance_from_onset = np.linalg.norm(centroids - centroids[0], axis=1)
    return np.stack(
        [
            peak_change,
            peak_change / time_course.peak.max(),
            mean_change,
            contact_area,
            half_peak_share,
            centroid_speed,
            distance_from_onset,
            np.sign(largest_displacement) * positions_on_axis,
        ],
        axis=1,
    )
