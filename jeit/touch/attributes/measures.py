"""Attributes of touch, each computed from recorded loads and responses, places, separations, areas or times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import real_array

# The least number of loads, and of touches with each.
_LEVELS, _REPEATS = 3, 3
# Shares of the response's rise or fall at which its time begins and ends.
_BEGUN, _DONE = 0.1, 0.9


class Localisation(NamedTuple):
    """Error of the estimated places of touches.

    `mean`, standard `deviation` and `most`, the greatest, metres; `missed`: the share of touches that were not found.
    """

    mean: float
    deviation: float
    most: float
    missed: float


class ContactArea(NamedTuple):
    """Linear relation of estimated to true contact areas: `least` + `gain` × the true area, m², with this
    `correlation`.

    `least` is the estimated area of a point, a measure of the skin's blur.
    """

    gain: float
    least: float
    correlation: float


def weber_ratio(load: ArrayLike, response: ArrayLike) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Weber's ratio: at each of the k loads, newtons, the least relative change of load that can be detected.

    It is the standard deviation of the response to the load over its slope, and over the load; infinite where the
    response does not rise. Returns the loads and the ratios. `load` (n,), newtons, three or more different loads, each
    applied three times or more; `response` (n,), in any unit, such as the peak of an image. Such a change moves the
    response by one deviation (d′ = 1). Raises `ValueError` for fewer, loads that are not positive, other lengths, and
    NaN.
    """
    load, response = _pair("load", load, "response", response)
    if (load <= 0).any():
        raise ValueError("load must be positive, in newtons.")
    levels, which, count = np.unique(load, return_inverse=True, return_counts=True)
    if len(levels) < _LEVELS or count.min() < _REPEATS:
        raise ValueError(
            f"load: give {_LEVELS} loads or more, each {_REPEATS} times or more; there are {len(levels)}, one of them "
            f"{count.min()} times."
        )
    mean = np.bincount(which, response) / count
    deviation = np.sqrt(np.bincount(which, (response - mean[which]) ** 2) / (count - 1))
    slope = np.gradient(mean, levels) * (1.0 if mean[-1] >= mean[0] else -1.0)
    with np.errstate(divide="ignore"):
        return levels, np.where(slope > 0, deviation / (np.maximum(slope, 0.0) * levels), np.inf)


def point_localisation(place: ArrayLike, found: ArrayLike) -> Localisation:
    """Error of touches at a `place` (n, 2 or 3) that are `found` (n, 2 or 3) elsewhere, metres; NaN where none was
    found.

    Raises `ValueError` for other shapes, and where nothing was found at all.
    """
    place = real_array("place", place, "metres (n, 2) or (n, 3)")
    found = real_array("found", found, "metres, as many as places, NaN where nothing was found")
    if place.ndim != 2 or place.shape != found.shape or not np.isfinite(place).all():
        raise ValueError(f"place and found must be (n, 2) or (n, 3); they have shapes {place.shape}, {found.shape}.")
    off = np.linalg.norm(found - place, axis=1)
    there = np.isfinite(off)
    if not there.any():
        raise ValueError("found: nothing was found of any touch.")
    off = off[there]
    return Localisation(float(off.mean()), float(off.std()), float(off.max()), float(1 - there.mean()))


def least_detected(amount: ArrayLike, detected: ArrayLike) -> float:
    """The least amount that is detected in half of the trials, in its unit; infinite if there is none.

    An amount may be the separation of two points that are distinguished, or the gap between two touches. `amount` (n,)
    of each trial; `detected` (n,), true or false. The detected share is assumed to rise with the amount (isotonic
    regression), linearly between amounts. Raises `ValueError` for other lengths, and NaN.
    """
    from scipy.optimize import isotonic_regression

    detected = np.asarray(detected)
    if detected.dtype.kind != "b":
        raise ValueError(f"detected must be true or false for each trial; it is {detected.dtype}.")
    amount, detected = _pair("amount", amount, "detected", detected.astype(float))
    levels, which, count = np.unique(amount, return_inverse=True, return_counts=True)
    share = isotonic_regression(np.bincount(which, detected) / count, weights=count).x
    above = int(np.argmax(share >= 0.5))
    if share[above] < 0.5:
        return float("inf")
    if not above:
        return float(levels[0])
    part = (0.5 - share[above - 1]) / (share[above] - share[above - 1])
    return float(levels[above - 1] + part * (levels[above] - levels[above - 1]))


def contact_area(area: ArrayLike, found: ArrayLike) -> ContactArea:
    """Fit areas `found` (n,) to the true areas `area` (n,), m², by least squares.

    Raises `ValueError` for other lengths, NaN, and areas that are all the same.
    """
    area, found = _pair("area", area, "found", found)
    if len(area) < 2 or (area == area[0]).all():
        raise ValueError("area: give two different areas, or more.")
    gain, least = np.polyfit(area, found, 1)
    alike = found.std() > 0
    return ContactArea(float(gain), float(least), float(np.corrcoef(area, found)[0, 1]) if alike else 0.0)


def response_times(seconds: ArrayLike, response: ArrayLike) -> tuple[float, float]:
    """Rise and fall time, seconds, of the response (T,) to a touch that begins and ends abruptly.

    The rise is from 10 to 90 % of the greatest value, the fall from 90 to 10 % after its last occurrence; the fall is
    infinite where the `seconds` (T,) end before it. Before the first frame nothing touches. Raises `ValueError` for
    other lengths, times that do not rise, NaN, and a response that is nowhere positive.
    """
    seconds, response = _pair("seconds", seconds, "response", response)
    if (np.diff(seconds) <= 0).any():
        raise ValueError("seconds must rise.")
    size = float(response.max())
    if size <= 0:
        raise ValueError("response is nowhere positive; give one in which touches are.")
    begun, done = (int(np.argmax(response >= share * size)) for share in (_BEGUN, _DONE))
    last = len(response) - 1 - int(np.argmax(response[::-1] >= _DONE * size))
    after = response[last:] < _BEGUN * size
    gone = float(seconds[last + int(np.argmax(after))] - seconds[last]) if after.any() else float("inf")
    return float(seconds[done] - seconds[begun]), gone


def _pair(first: str, one: ArrayLike, second: str, other: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Check that both are (n,) and finite."""
    left, right = real_array(first, one, "numbers (n,)"), real_array(second, other, "numbers (n,)")
    if left.ndim != 1 or left.shape != right.shape or not left.size:
        raise ValueError(f"{first} and {second} must be (n,), as many; they have shapes {left.shape}, {right.shape}.")
    for name, values in ((first, left), (second, right)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} has NaN or infinite values.")
    return left, right
