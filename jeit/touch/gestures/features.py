"""Features of touches: the seven of Silvera Tawil et al. (2011), table II, and more of the touch's course."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.touch.gestures.segmentation import ChangeCourse, StreamTouch

# Names and units; "image" stands for that of the images of change: siemens (a sheet's) or S/m.
FEATURES = {
    "greatest change": "image",
    "least change": "image",
    "share above half": "1",
    "mean in contact": "image",
    "duration": "s",
    "rate of change": "image/s",
    "displacement": "m",
}
"""The seven features of a touch, by name, each with its unit; "image" stands for that of the images."""

# The number of instants of a touch, from onset to end, at which P is taken.
_PLACES = 16
_MORE = (
    "area", "area spread", "path length", "farthest", "speed", "fastest", "straightness", "peaks", "rise", "decay",
    "roughness", "pauses", "centre of gravity", "breadth",
)  # fmt: skip
COURSE_FEATURES = (*FEATURES, *_MORE, *(f"course {one + 1}" for one in range(_PLACES)))
"""Names of the features of `course_features`: the seven, more of the same course, and P from onset to end."""

SEQUENCE_PLACES = 32
SEQUENCE_VALUES = ("change", "share", "mean", "area", "half", "speed", "distance", "along")
"""Values of `sequence_features` at each of `SEQUENCE_PLACES` instants of a touch, from onset to end."""
SEQUENCE_FEATURES = (
    *COURSE_FEATURES, *(f"{name} {one + 1}" for one in range(SEQUENCE_PLACES) for name in SEQUENCE_VALUES)
)  # fmt: skip
"""Names of the features of `sequence_features`."""


@dataclass(frozen=True)
class TouchFeatures:
    """Features of n touches: `values` (n, k), a column for each of `names`, in `units`."""

    values: Float[np.ndarray, "n k"]
    names: tuple[str, ...]
    units: tuple[str, ...]

    def __len__(self) -> int:
        """Number of touches."""
        return len(self.values)


def touch_features(touches: list[StreamTouch] | tuple[StreamTouch, ...]) -> TouchFeatures:
    """The seven features of n touches, with x_e the change of element e, P(t) = max_e x_e, and t* when it is greatest.

    Greatest P; least x_e, of all elements and frames of the touch; share of the elements with x_e ≥ P / 2 at t*; mean
    x_e at t* over the elements above the level that a touch exceeds; duration, s, of the frames above it;
    mean of |dP/dt|, 0 of one frame; distance of the last centroid from the first, m. Silvera Tawil et al. (2011),
    table II and section IV-A. Raises `ValueError` for what is no list of touches.
    """
    courses = _courses(touches)
    values = np.array([_seven(one) for one in courses]).reshape(len(courses), len(FEATURES))
    return TouchFeatures(values, tuple(FEATURES), tuple(FEATURES.values()))


def course_features(touches: list[StreamTouch] | tuple[StreamTouch, ...]) -> TouchFeatures:
    """Compute the seven features of n touches and more of their courses, `COURSE_FEATURES`.

    They are: mean and spread of the contact's area; the path's length, its farthest distance from its beginning, mean
    and greatest speed, and displacement over length; peaks of P a touch; how fast P rises to its greatest and falls
    from there; how rough it is; the share of frames below half of it; the mean and the spread in time of P; and P / max
    P at instants evenly spread in time. Raises `ValueError` for what is no list of touches.
    """
    courses = _courses(touches)
    seven = touch_features(touches)
    values = np.array([_more(one) for one in courses]).reshape(len(courses), len(_MORE) + _PLACES)
    units = ("m²", "1", "m", "m", "m/s", "m/s", "1", "1", "s", "s", "1", "1", "1", "1", *["1"] * _PLACES)
    return TouchFeatures(np.hstack([seven.values, values]), COURSE_FEATURES, (*seven.units, *units))


def sequence_features(touches: list[StreamTouch] | tuple[StreamTouch, ...]) -> TouchFeatures:
    """Compute `course_features` of n touches and their whole course, `SEQUENCE_FEATURES`.

    The course has, at instants evenly spread in time: P; P / max P; mean change and area in contact; the share of
    elements above half of P; the centroid's speed, its distance from where it began, and its position along the line
    that it mainly moves along, initially forwards. Raises `ValueError` for what is no list of touches.
    """
    courses = _courses(touches)
    whole = course_features(touches)
    wide = SEQUENCE_PLACES * len(SEQUENCE_VALUES)
    values = np.array([_sequence(one).ravel() for one in courses]).reshape(len(courses), wide)
    units = ("image", "1", "image", "m²", "1", "m/s", "m", "m") * SEQUENCE_PLACES
    return TouchFeatures(np.hstack([whole.values, values]), SEQUENCE_FEATURES, (*whole.units, *units))


def _courses(touches) -> list[ChangeCourse]:
    check_kind("touches", touches, (list, tuple), "a list of touches, such as of find_touches")
    for number, one in enumerate(touches):
        check_kind(f"touches[{number}]", one, StreamTouch, "a StreamTouch, such as of find_touches")
    return [one.course for one in touches]


def _seven(course: ChangeCourse) -> list[float]:
    at = int(course.peak.argmax())
    passed = np.diff(course.seconds)
    rate = np.mean(np.abs(np.diff(course.peak)) / passed) if passed.size else 0.0
    return [
        course.peak[at],
        course.least.min(),
        course.half_share[at],
        course.mean[at],
        course.seconds[-1] - course.seconds[0],
        float(rate),
        float(np.linalg.norm(course.centroid[-1] - course.centroid[0])),
    ]


def _more(course: ChangeCourse) -> list[float]:
    there = np.isfinite(course.centroid[:, 0])  # no centroid in a bridged frame
    place, seconds = course.centroid[there], course.seconds[there]
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    length, moved = float(steps.sum()), float(np.linalg.norm(place[-1] - place[0]))
    duration = max(course.seconds[-1] - course.seconds[0], 1e-9)
    speeds = steps / np.diff(seconds) if steps.size else np.zeros(1)
    share = course.peak / course.peak.max()
    at = int(share.argmax())
    when = (course.seconds - course.seconds[0]) / duration
    weight = share / share.sum()
    middle = float(weight @ when)
    rises = np.diff(share)
    turns = np.flatnonzero((rises[:-1] > 0) & (rises[1:] <= 0)) + 1
    return [
        float(course.area[there].mean()),
        float(course.area[there].std() / course.area[there].mean()),
        length,
        float(np.linalg.norm(place - place[0], axis=1).max()),
        length / duration,
        float(np.quantile(speeds, 0.9)),
        moved / max(length, 1e-9),
        float(max(np.count_nonzero(share[turns] > 0.5), 1)),
        float(course.seconds[at] - course.seconds[0]),
        float(course.seconds[-1] - course.seconds[at]),
        float(np.abs(rises).sum()),
        float(np.mean(share < 0.5)),
        middle,
        float(np.sqrt(weight @ (when - middle) ** 2)),
        *np.interp(np.linspace(0, 1, _PLACES), when, share),
    ]


def _sequence(course: ChangeCourse) -> Float[np.ndarray, "T c"]:
    """`SEQUENCE_VALUES` at `SEQUENCE_PLACES` instants."""
    seconds = course.seconds
    when = np.linspace(seconds[0], seconds[-1], SEQUENCE_PLACES)
    there = np.isfinite(course.centroid[:, 0])  # no centroid in a bridged frame
    place = np.stack([np.interp(when, seconds[there], one[there]) for one in course.centroid.T], axis=1)
    steps = np.linalg.norm(np.diff(place, axis=0, prepend=place[:1]), axis=1)
    speed = steps / max((seconds[-1] - seconds[0]) / (SEQUENCE_PLACES - 1), 1e-9)
    middle = place - place.mean(axis=0)
    along = middle @ np.linalg.svd(middle, full_matrices=False)[2][0]
    along = along - along[0]
    forwards = along[np.abs(along).argmax()]
    change, mean, area, half = (
        np.interp(when, seconds, one) for one in (course.peak, course.mean, course.area, course.half_share)
    )
    distance = np.linalg.norm(place - place[0], axis=1)
    return np.stack(
        [change, change / course.peak.max(), mean, area, half, speed, distance, np.sign(forwards) * along], axis=1
    )
