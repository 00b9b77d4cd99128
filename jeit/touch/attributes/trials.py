"""Measure all attributes of touch of one skin, by trials on a real or a simulated skin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_key, check_kind, describe, is_number, real_array
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.touch.attributes.measures import (
    ContactArea,
    Localisation,
    contact_area,
    least_detected,
    point_localisation,
    response_times,
    weber_ratio,
)
from jeit.touch.contacts import Contact, ImageNoise, find_contacts
from jeit.touch.contacts.finder import AbstractFinder

# Numbers of untouched frames, repeats of a load, places, and trials of each separation.
_UNTOUCHED, _REPEATS, _PLACES, _TRIALS = 50, 8, 40, 8
# As multiples of the load: those at which Weber's ratio is measured. As multiples of the disc's diameter: separations,
# from centre to centre, and diameters of other discs under the same pressure.
_LOADS = np.geomspace(0.25, 4.0, 7)
_SEPARATIONS = np.array([1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0])
_DIAMETERS = np.array([1.0, 1.5, 2.0, 3.0, 4.0])


class DiscTouch(NamedTuple):
    """A flat disc of a `diameter`, metres, that presses with a `load`, newtons, at a `place` (x, y), metres."""

    place: Float[np.ndarray, "2"]
    load: float
    diameter: float


class TouchAttributes(NamedTuple):
    """The attributes of touch of a skin.

    **Fields**: `load` (k,), newtons, and `weber` (k,), the least relative change of each that is detected;
    `localisation`, metres; `two_points`, metres, the distance between the centres of two discs that are distinguished
    in half of the trials; `area`; `rise` and `fall`, seconds, of the image's response to a touch that begins and ends
    abruptly, None where none was recorded.
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
    """Measure a real or simulated skin, through `linear` images of its changes and the contacts that `finder` finds.

    `press` is given n touches, each a list of simultaneous discs, none for an untouched skin, and returns a frame (n,
    M), volts, of each: a robot with discs, or a simulated skin. Discs of a `diameter`, metres, press with a `load`,
    newtons, or from a quarter to four times that, near the `middle` (x, y); for localisation, anywhere in a disk of
    radius `within`, metres, about it. `recording`: seconds (T,), and frames (T, M) of one touch that begins and ends
    abruptly. `key` draws places and directions; `progress` is called with what is measured. Raises `ValueError` for
    what is no key, image or finder, sizes and loads that are not positive, frames of another shape, and a skin on which
    nothing is found.
    """
    check_key(key)
    if not callable(press):
        raise ValueError(f"press must be a function from touches to frames (n, M); it is {describe(press)}.")
    check_kind("linear", linear, LinearReconstruction, "linear images, such as of one_step(...)")
    check_kind("finder", finder, AbstractFinder, "a finder, such as CellFinder(mesh)")
    for name, value in (("within", within), ("load", load), ("diameter", diameter)):
        if not (is_number(value) and value > 0):
            raise ValueError(f"{name} must be positive; it is {describe(value)}.")
    centre = real_array("middle", middle, "(x, y) in metres")
    if centre.shape != (2,):
        raise ValueError(f"middle must be (x, y) in metres; it has shape {centre.shape}.")
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    report = progress or (lambda said: None)
    report("untouched frames")
    untouched = _frames(press([[] for _ in range(_UNTOUCHED)]), _UNTOUCHED, linear)
    reference, noise = untouched.mean(axis=0), ImageNoise.of_frames(linear, untouched)

    def contacts_in(frames: np.ndarray) -> list[list[Contact]]:
        return [find_contacts(finder, image, noise) for image in np.asarray(linear.image(frames - reference))]

    def contacts(touches: Sequence[Sequence[DiscTouch]]) -> list[list[Contact]]:
        return contacts_in(_frames(press(touches), len(touches), linear))

    report("Weber ratio")
    loads = np.repeat(load * _LOADS, _REPEATS)
    levels, weber = weber_ratio(
        loads, [_size(one) for one in contacts([[DiscTouch(centre, n, diameter)] for n in loads])]
    )
    report("localisation")
    places = centre + (within * np.sqrt(random.uniform(size=_PLACES)))[:, None] * _directions(random, _PLACES)
    found = contacts([[DiscTouch(place, load, diameter)] for place in places])
    localisation = point_localisation(places, np.array([_where(one) for one in found]))
    report("two points")
    apart = np.repeat(_SEPARATIONS * diameter, _TRIALS)
    half = apart[:, None] / 2 * _directions(random, len(apart))
    found = contacts([[DiscTouch(centre + way * one, load, diameter) for way in (-1, 1)] for one in half])
    two_points = least_detected(apart, np.array([len(one) > 1 for one in found]))
    report("contact area")
    wide = np.repeat(_DIAMETERS, _REPEATS)
    found = contacts([[DiscTouch(centre, load * one**2, one * diameter)] for one in wide])
    area = contact_area(np.pi / 4 * (wide * diameter) ** 2, [one[0].area if one else 0.0 for one in found])
    rise = fall = None
    if recording is not None:
        report("times")
        seconds = real_array("recording", recording[0], "seconds (T,), and frames (T, M)")
        frames = _frames(recording[1], len(np.atleast_1d(seconds)), linear)
        rise, fall = response_times(seconds, [_size(one) for one in contacts_in(frames)])
    return TouchAttributes(levels, weber, localisation, two_points, area, rise, fall)


def _frames(given, number: int, linear: LinearReconstruction) -> Float[np.ndarray, "n M"]:
    frames, wanted = real_array("frames", given, "volts (n, M)"), (number, linear.num_measurements)
    if frames.shape != wanted or not np.isfinite(frames).all():
        raise ValueError(f"frames must be finite volts {wanted}, one for each touch; they have shape {frames.shape}.")
    return frames


def _directions(random: np.random.Generator, number: int) -> Float[np.ndarray, "n 2"]:
    angle = random.uniform(0, 2 * np.pi, number)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _size(found: list[Contact]) -> float:
    """Peak of the strongest contact; 0 if there is none."""
    return abs(found[0].peak) if found else 0.0


def _where(found: list[Contact]) -> np.ndarray:
    """Centroid of the strongest contact; NaN if there is none."""
    return found[0].centroid if found else np.full(2, np.nan)
