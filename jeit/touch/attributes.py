"""Five measures of a skin's resolution: the attributes of touch of Silvera Tawil et al. 2011, section IV-A.

Each measure is computed from recordings of a skin. `touch_attributes` requests all the touches that are needed, from a
robot or a simulated skin, and computes all five measures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, describe, is_number, real_array
from jeit.arguments.moved_names import with_moved_names as _with_moved_names
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.touch.contacts import Contact, ImageNoise, find_contacts
from jeit.touch.contacts.finder import AbstractFinder

# Minimum number of different loads.
_MIN_NUM_LOADS = 3
# Minimum number of touches with each load.
_MIN_NUM_REPETITIONS = 3
# Fractions of the maximum response between which rise and fall times are measured.
_RISE_START_FRACTION, _RISE_END_FRACTION = 0.1, 0.9


class Localisation(NamedTuple):
    """Error of the estimated places of touches.

    `mean`, `deviation` and `most`: mean, standard deviation and maximum of the error, metres; `missed`: share of
    touches that were not detected.
    """

    mean: float
    deviation: float
    most: float
    missed: float


class ContactArea(NamedTuple):
    """Linear relation between contact areas: the estimated area is `least` + `gain` × the true area, all in m².

    `least`: estimated area of a contact at a point, a measure of the skin's blur, m²; `correlation`: correlation of the
    estimated with the true areas.
    """

    gain: float
    least: float
    correlation: float


def weber_ratio(load: ArrayLike, response: ArrayLike) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Compute Weber's ratio at each of k loads: the smallest relative change of load that can be detected.

    A change of load is detected if it changes the response by one standard deviation (d′ = 1). So the ratio is the
    standard deviation of the response, divided by the load and by the slope of the response against the load. The ratio
    is infinite at loads where the response does not rise with the load. `load` (n,), newtons: three or more different
    loads, each applied three times or more; `response` (n,), in any unit, such as the peak of an image. Returns the
    loads (k,), newtons, and the ratios (k,). Raises `ValueError` for fewer than three loads, loads that are not
    positive, arrays of different lengths, and NaN.
    """
    load, response = _check_pair("load", load, "response", response)
    if (load <= 0).any():
        raise ValueError("load must be positive, in newtons.")
    distinct_loads, load_indices, repetition_counts = np.unique(load, return_inverse=True, return_counts=True)
    if len(distinct_loads) < _MIN_NUM_LOADS or repetition_counts.min() < _MIN_NUM_REPETITIONS:
        raise ValueError(
            f"load: give {_MIN_NUM_LOADS} loads or more, each {_MIN_NUM_REPETITIONS} times or more; there are "
            f"{len(distinct_loads)}, one of them {repetition_counts.min()} times."
        )
    mean_responses = np.bincount(load_indices, response) / repetition_counts
    response_deviations = np.sqrt(
        np.bincount(load_indices, (response - mean_responses[load_indices]) ** 2) / (repetition_counts - 1)
    )
    response_slopes = np.gradient(mean_responses, distinct_loads) * (
        1.0 if mean_responses[-1] >= mean_responses[0] else -1.0
    )
    with np.errstate(divide="ignore"):
        return distinct_loads, np.where(
            response_slopes > 0, response_deviations / (np.maximum(response_slopes, 0.0) * distinct_loads), np.inf
        )


def point_localisation(place: ArrayLike, found: ArrayLike) -> Localisation:
    """Compute the error of estimated places `found` (n, 2) or (n, 3) of touches whose true places are `place`, metres.

    `found` is NaN for touches that were not detected. Raises `ValueError` for other shapes, and if no touch was
    detected.
    """
    place = real_array("place", place, "metres (n, 2) or (n, 3)")
    found = real_array("found", found, "metres, as many as places, NaN where nothing was found")
    if place.ndim != 2 or place.shape != found.shape or not np.isfinite(place).all():
        raise ValueError(f"place and found must be (n, 2) or (n, 3); they have shapes {place.shape}, {found.shape}.")
    place_errors = np.linalg.norm(found - place, axis=1)
    is_found = np.isfinite(place_errors)
    if not is_found.any():
        raise ValueError("found: every row is NaN; no touch was found.")
    place_errors = place_errors[is_found]
    return Localisation(
        float(place_errors.mean()), float(place_errors.std()), float(place_errors.max()), float(1 - is_found.mean())
    )


def detection_threshold(amount: ArrayLike, detected: ArrayLike) -> float:
    """Compute the smallest amount, such as a distance, that is detected in half of the trials.

    An amount may be the separation of two points that are distinguished, or the gap between two touches. `amount` (n,):
    amount in each of n trials, in any unit, which is also the unit of the result; `detected` (n,): whether the amount
    was detected, true or false. The result is infinite if no amount is detected in half of the trials. The share of
    detections is assumed to rise with the amount (isotonic regression), and is interpolated linearly between amounts.
    Raises `ValueError` for arrays of different lengths, and NaN.
    """
    from scipy.optimize import isotonic_regression

    detected = np.asarray(detected)
    if detected.dtype.kind != "b":
        raise ValueError(f"detected must be true or false for each trial; it is {detected.dtype}.")
    amount, detected = _check_pair("amount", amount, "detected", detected.astype(float))
    distinct_amounts, amount_indices, trial_counts = np.unique(amount, return_inverse=True, return_counts=True)
    detection_rates = isotonic_regression(np.bincount(amount_indices, detected) / trial_counts, weights=trial_counts).x
    first_index = int(np.argmax(detection_rates >= 0.5))
    if detection_rates[first_index] < 0.5:
        return float("inf")
    if not first_index:
        return float(distinct_amounts[0])
    interpolation_fraction = (0.5 - detection_rates[first_index - 1]) / (
        detection_rates[first_index] - detection_rates[first_index - 1]
    )
    return float(
        distinct_amounts[first_index - 1]
        + interpolation_fraction * (distinct_amounts[first_index] - distinct_amounts[first_index - 1])
    )


def contact_area(area: ArrayLike, found: ArrayLike) -> ContactArea:
    """Fit a linear relation between true areas `area` (n,) and estimated areas `found` (n,), m², by least squares.

    Raises `ValueError` for arrays of different lengths, NaN, and true areas that are all the same.
    """
    area, found = _check_pair("area", area, "found", found)
    if len(area) < 2 or (area == area[0]).all():
        raise ValueError("area: give two different areas, or more.")
    gain, intercept = np.polyfit(area, found, 1)
    has_variation = found.std() > 0
    return ContactArea(float(gain), float(intercept), float(np.corrcoef(area, found)[0, 1]) if has_variation else 0.0)


def response_times(seconds: ArrayLike, response: ArrayLike) -> tuple[float, float]:
    """Compute the rise time and the fall time, seconds, of the response to a touch that begins and ends abruptly.

    `seconds` (T,): times of the frames; `response` (T,): the response at these times. Nothing touches the skin before
    the first frame. The rise time is the time in which the response rises from 10 to 90 % of its maximum. The fall time
    is the time from the last value above 90 % to the next value below 10 %; it is infinite if the recording ends before
    this value. Raises `ValueError` for arrays of different lengths, times that do not increase, NaN, and a response
    that is nowhere positive.
    """
    seconds, response = _check_pair("seconds", seconds, "response", response)
    if (np.diff(seconds) <= 0).any():
        raise ValueError("seconds must increase from frame to frame.")
    max_response = float(response.max())
    if max_response <= 0:
        raise ValueError(
            "response is nowhere positive; give the response to a touch, with the sign that makes it positive."
        )
    rise_start_index, rise_end_index = (
        int(np.argmax(response >= fraction * max_response)) for fraction in (_RISE_START_FRACTION, _RISE_END_FRACTION)
    )
    fall_start_index = len(response) - 1 - int(np.argmax(response[::-1] >= _RISE_END_FRACTION * max_response))
    is_below_rise_start = response[fall_start_index:] < _RISE_START_FRACTION * max_response
    fall_time = (
        float(seconds[fall_start_index + int(np.argmax(is_below_rise_start))] - seconds[fall_start_index])
        if is_below_rise_start.any()
        else float("inf")
    )
    return float(seconds[rise_end_index] - seconds[rise_start_index]), fall_time


def _check_pair(
    first_name: str, first_array: ArrayLike, second_name: str, second_array: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Convert two arrays to numbers, and check that both are (n,) and finite."""
    first_values, second_values = (
        real_array(first_name, first_array, "numbers (n,)"),
        real_array(second_name, second_array, "numbers (n,)"),
    )
    if first_values.ndim != 1 or first_values.shape != second_values.shape or not first_values.size:
        raise ValueError(
            f"{first_name} and {second_name} must be (n,), as many; they have shapes {first_values.shape}, "
            f"{second_values.shape}."
        )
    for argument_name, argument_values in ((first_name, first_values), (second_name, second_values)):
        if not np.isfinite(argument_values).all():
            raise ValueError(f"{argument_name} has NaN or infinite values.")
    return first_values, second_values


# Number of untouched frames.
_NUM_UNTOUCHED_FRAMES = 50
# Number of repetitions of each load and of each area.
_NUM_REPETITIONS = 8
# Number of places.
_NUM_PLACES = 40
# Number of trials of each separation.
_NUM_TRIALS = 8
# Loads at which Weber's ratio is measured, relative to the usual load; distances between the centres of two discs,
# relative to the usual diameter; diameters of discs under the same pressure, relative to the usual diameter.
_RELATIVE_LOADS = np.geomspace(0.25, 4.0, 7)
_RELATIVE_SEPARATIONS = np.array([1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0])
_RELATIVE_DIAMETERS = np.array([1.0, 1.5, 2.0, 3.0, 4.0])


class DiscTouch(NamedTuple):
    """A flat disc that presses on a skin.

    `place`: (x, y), metres; `load`: its force, newtons; `diameter`, metres.
    """

    place: Float[np.ndarray, "2"]
    load: float
    diameter: float


class TouchAttributes(NamedTuple):
    """Five measures of a skin's resolution, the attributes of touch, as `touch_attributes` computes them.

    **Fields**: `load` (k,): k loads, newtons; `weber` (k,): smallest relative change of each load that is detected;
    `localisation`: error of the estimated places of touches, metres; `two_points`: distance between the centres of two
    discs that are distinguished in half of the trials, metres; `area`: relation of estimated to true contact areas;
    `rise` and `fall`: rise and fall time of the response to a touch that begins and ends abruptly, seconds, None if no
    such touch was recorded.

    **Example:**

    ```python
    attributes = touch_attributes(key, pressed, linear, finder)
    print(isinstance(attributes, TouchAttributes), attributes.localisation.mean)
    ```
    """

    load: Float[np.ndarray, " k"]
    weber: Float[np.ndarray, " k"]
    localisation: Localisation
    two_points: float
    area: ContactArea
    rise: float | None
    fall: float | None


def touch_attributes(
    key: Array,
    press: Callable[[Sequence[Sequence[DiscTouch]]], ArrayLike],
    linear: LinearReconstruction,
    finder: AbstractFinder,
    *,
    middle: ArrayLike = (0.0, 0.0),
    within: float = 0.03,
    load: float = 1.0,
    diameter: float = 0.01,
    recording: tuple[ArrayLike, ArrayLike] | None = None,
    progress: Callable[[str], None] | None = None,
) -> TouchAttributes:
    """Measure the resolution of a real or simulated skin: its five attributes of touch.

    Discs press on the skin. Most have the usual diameter and load; some have a quarter to four times the load, others
    up to four times the diameter under the same pressure.

    **Arguments:**

    - `key`: random key from which places and directions are drawn.
    - `press`: function that presses discs on the skin: it commands a robot, or simulates a skin. Its argument is a list
      of n touches, each a list of simultaneous discs, empty for an untouched skin. It returns their frames (n, M),
      volts, of M channels.
    - `linear`: linear reconstruction that computes an image from the change of a frame.
    - `finder`: finder that finds the contacts in these images.
    - `middle`: middle (x, y) of the region of the touches, metres.
    - `within`: radius of this region, metres.
    - `load`: usual load, newtons.
    - `diameter`: usual diameter of a disc, metres.
    - `recording`: times (T,), seconds, and frames (T, M), volts, of a touch that begins and ends abruptly.
    - `progress`: function that is called with the name of each measurement, such as "two points", when it begins.

    Raises `ValueError` for an invalid key, `linear` or `finder`, sizes and loads that are not positive, frames of the
    wrong shape, and a skin on which no touch is detected.

    **Example:**

    ```python
    attributes = touch_attributes(key, pressed, linear, finder)
    print(attributes.localisation.mean, attributes.two_points)  # metres
    ```
    """
    check_key(key)
    if not callable(press):
        raise ValueError(f"press must be a function from touches to frames (n, M); it is {describe(press)}.")
    check_kind("linear", linear, LinearReconstruction, "linear images, such as of one_step(...)")
    check_kind("finder", finder, AbstractFinder, "a finder, such as CellFinder(mesh)")
    for option_name, option_value in (("within", within), ("load", load), ("diameter", diameter)):
        if not (is_number(option_value) and option_value > 0):
            raise ValueError(f"{option_name} must be positive; it is {describe(option_value)}.")
    centre = real_array("middle", middle, "(x, y) in metres")
    if centre.shape != (2,):
        raise ValueError(f"middle must be (x, y) in metres; it has shape {centre.shape}.")
    generator = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    report_progress = progress or (lambda message: None)
    report_progress("untouched frames")
    untouched = _check_frames(press([[] for _ in range(_NUM_UNTOUCHED_FRAMES)]), _NUM_UNTOUCHED_FRAMES, linear)
    reference, image_noise = untouched.mean(axis=0), ImageNoise.of_frames(linear, untouched)

    def find_in_frames(frames: np.ndarray) -> list[list[Contact]]:
        return [find_contacts(finder, image, image_noise) for image in np.asarray(linear.image(frames - reference))]

    def detect_touches(touches: Sequence[Sequence[DiscTouch]]) -> list[list[Contact]]:
        return find_in_frames(_check_frames(press(touches), len(touches), linear))

    report_progress("Weber ratio")
    applied_loads = np.repeat(load * _RELATIVE_LOADS, _NUM_REPETITIONS)
    distinct_loads, weber_ratios = weber_ratio(
        applied_loads,
        [
            _strongest_peak(contacts)
            for contacts in detect_touches([[DiscTouch(centre, disc_load, diameter)] for disc_load in applied_loads])
        ],
    )
    report_progress("localisation")
    true_places = centre + (within * np.sqrt(generator.uniform(size=_NUM_PLACES)))[:, None] * _random_directions(
        generator, _NUM_PLACES
    )
    contacts_of_touches = detect_touches([[DiscTouch(place, load, diameter)] for place in true_places])
    localisation = point_localisation(
        true_places, np.array([_strongest_centroid(contacts) for contacts in contacts_of_touches])
    )
    report_progress("two points")
    point_separations = np.repeat(_RELATIVE_SEPARATIONS * diameter, _NUM_TRIALS)
    half_separations = point_separations[:, None] / 2 * _random_directions(generator, len(point_separations))
    contacts_of_touches = detect_touches(
        [
            [DiscTouch(centre + direction_sign * half_separation, load, diameter) for direction_sign in (-1, 1)]
            for half_separation in half_separations
        ]
    )
    two_points = detection_threshold(
        point_separations, np.array([len(contacts) > 1 for contacts in contacts_of_touches])
    )
    report_progress("contact area")
    relative_diameters = np.repeat(_RELATIVE_DIAMETERS, _NUM_REPETITIONS)
    contacts_of_touches = detect_touches(
        [
            [DiscTouch(centre, load * relative_diameter**2, relative_diameter * diameter)]
            for relative_diameter in relative_diameters
        ]
    )
    fitted_area = contact_area(
        np.pi / 4 * (relative_diameters * diameter) ** 2,
        [contacts[0].area if contacts else 0.0 for contacts in contacts_of_touches],
    )
    rise_time = fall_time = None
    if recording is not None:
        report_progress("times")
        seconds = real_array("recording", recording[0], "seconds (T,), and frames (T, M)")
        frames = _check_frames(recording[1], len(np.atleast_1d(seconds)), linear)
        rise_time, fall_time = response_times(
            seconds, [_strongest_peak(contacts) for contacts in find_in_frames(frames)]
        )
    return TouchAttributes(distinct_loads, weber_ratios, localisation, two_points, fitted_area, rise_time, fall_time)


def _check_frames(
    frames_given, num_touches: int, linear_reconstruction: LinearReconstruction
) -> Float[np.ndarray, "n M"]:
    """Convert frames to an array. Raises `ValueError` unless they are finite (touches, M channels)."""
    frames, required_shape = (
        real_array("frames", frames_given, "volts (n, M)"),
        (num_touches, linear_reconstruction.num_measurements),
    )
    if frames.shape != required_shape or not np.isfinite(frames).all():
        raise ValueError(
            f"frames must be finite volts {required_shape}, one for each touch; they have shape {frames.shape}."
        )
    return frames


def _random_directions(generator: np.random.Generator, num_directions: int) -> Float[np.ndarray, "n 2"]:
    """Draw `num_directions` random unit vectors."""
    direction_angles = generator.uniform(0, 2 * np.pi, num_directions)
    return np.stack([np.cos(direction_angles), np.sin(direction_angles)], axis=1)


def _strongest_peak(contacts: list[Contact]) -> float:
    """Return the magnitude of the peak of the strongest contact; 0 without a contact."""
    return abs(contacts[0].peak) if contacts else 0.0


def _strongest_centroid(contacts: list[Contact]) -> np.ndarray:
    """Return the centroid (2,) of the strongest contact, metres; NaN without a contact."""
    return contacts[0].centroid if contacts else np.full(2, np.nan)


__getattr__ = _with_moved_names(__name__)
