"""Simulated people who make gestures on a skin: parameters of the gestures, and motion of the hand.

Table I of Silvera Tawil et al. (2011) describes how six gestures are usually made, in words for area, intensity,
displacement and duration. The numbers for these words are assumptions from everyday touch, and each word has the same
number for all gestures: the contact of a fingertip has a radius of 7 mm, that of a flat hand through foam about 20 mm;
typing takes 1 N, resting fingers 2 N, a firm push 10 N; a knock lasts 0.15 s, a caress about 1 s. Words for a range,
such as small to large, have a larger spread among people. For displacement in the plane, the table states only whether
there is any. Here, fingers stroke at about 0.1 m/s over the length of a hand, and scratch back and forth, faster and
over a shorter path.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_key, check_kind, check_name, describe, is_number
from jeit.mesh import Domain
from jeit.touch.simulate.contact.combined_skins import JoinedIndenters, PlacedIndenter
from jeit.touch.simulate.contact.indenters import DiscIndenter
from jeit.touch.simulate.contact.press import MovingPress
from jeit_solvers.module import Module

TRAITS = ("force", "radius", "duration", "speed", "path")
"""Parameters of a touch: force, N; radius of a disc with the area of the contact, m; duration, s; and, for moving
touches, speed, m/s, and length of one sweep of the path, m."""

# Median of a parameter, and standard deviation of its logarithm among people, for each word of Table I. Units: m, N and
# s.
_SIZE_BY_WORD = {"small": (7e-3, 0.2), "sm-large": (12e-3, 0.45), "med-large": (20e-3, 0.3)}
_FORCE_BY_WORD = {"low": (1.0, 0.3), "low-med": (2.0, 0.4), "med-high": (5.0, 0.4), "high": (10.0, 0.3)}
_DURATION_BY_WORD = {"short": (0.15, 0.3), "med-long": (1.2, 0.4)}
# Standard deviation of the logarithm of speed and path among people.
_PATH_LOG_DEVIATION = 0.35
# Standard deviation of the logarithm of each parameter among touches of one person.
_TOUCH_LOG_DEVIATION = 0.25


@dataclass(frozen=True)
class Manner:
    """Description of how a gesture is made, in the words of Table I of Silvera Tawil et al. (2011).

    **Fields**: `area`, `intensity`, `duration`: words for the area of the contact, its force and duration; `speed`:
    speed of the contact, m/s, and `path`: length of a sweep, m, both 0 for gestures that do not move.
    """

    area: str
    intensity: str
    duration: str
    speed: float = 0.0
    path: float = 0.0

    @property
    def medians(self) -> Float[np.ndarray, " 5"]:
        """Medians (5,) of the parameters `TRAITS` among people, in SI units; speed and path may be 0."""
        return np.array([*(median_and_spread[0] for median_and_spread in self._word_parameters), self.speed, self.path])

    @property
    def spread(self) -> Float[np.ndarray, " 5"]:
        """Standard deviations (5,) of the logarithms of the parameters `TRAITS` among people."""
        return np.array(
            [
                *(median_and_spread[1] for median_and_spread in self._word_parameters),
                _PATH_LOG_DEVIATION,
                _PATH_LOG_DEVIATION,
            ]
        )

    @property
    def touch_spread(self) -> float:
        """Standard deviation of the logarithm of each of the parameters `TRAITS` among touches of one person."""
        return _TOUCH_LOG_DEVIATION

    @property
    def moves(self) -> bool:
        """Whether the contact moves along the skin."""
        return self.path > 0

    @property
    def _word_parameters(self) -> tuple[tuple[float, float], ...]:
        return _FORCE_BY_WORD[self.intensity], _SIZE_BY_WORD[self.area], _DURATION_BY_WORD[self.duration]


MANNERS: dict[str, Manner] = {
    "tap": Manner("small", "low", "short"),
    "pat": Manner("med-large", "low-med", "short"),
    "push": Manner("sm-large", "high", "med-long"),
    "stroke": Manner("med-large", "low-med", "med-long", speed=0.1, path=0.12),
    "scratch": Manner("sm-large", "med-high", "med-long", speed=0.2, path=0.05),
    "slap": Manner("med-large", "high", "short"),
}
"""The six gestures by name, in the order of the paper."""

GESTURES = tuple(MANNERS)
"""Names of the gestures."""


# Time recorded before a touch and minimum time after it, in seconds; the number of frames is a multiple of
# `_FRAME_MULTIPLE`.
_TIME_BEFORE, _TIME_AFTER, _FRAME_MULTIPLE = 0.1, 0.5, 16
# Maximum mean pressure of a hand, Pa.
_MAX_PRESSURE = 120e3
# Minimum distance of the hand's path from the edge of the skin, m.
_EDGE_MARGIN = 15e-3
# Maximum path of a hand that does not move along the skin but rolls, m.
_MAX_ROLLING_PATH_LENGTH = 2e-3
# Share of a long touch in which the load rises, and in which it falls.
_RAMP_FRACTION = 0.15
# Relative amplitude of fluctuations of the load.
_FLUCTUATION_AMPLITUDE = 0.08
# Number of fingertips that scratch.
_NUM_FINGERTIPS = 3
# Distance between the fingertips that scratch, divided by their radius.
_FINGERTIP_SPACING = 2.6
# Relative reduction of the load at the turning points of a scratch.
_LOAD_REDUCTION_AT_TURNS = 0.4
# Number of random places tried for a path on the skin.
_NUM_TRIED_PLACES = 20
# Factor by which a path is shortened if it fits at none of the tried places.
_SHORTENING_FACTOR = 0.8


def gesture_motion(
    rng: np.random.Generator, gesture: str, traits: Float[np.ndarray, " 5"], outline: Domain, rate: float
) -> tuple[MovingPress, Float[np.ndarray, " T"]]:
    """Simulate a gesture with the given `traits` (see `TRAITS`, SI units) at a random place on the skin.

    Returns the moving press and the times (T,) of its frames, seconds, at `rate` frames/s. The frames begin 0.1 s
    before the gesture, and end 0.5 s or more after it, since the skin recovers slowly.
    """
    press_force, contact_radius, touch_duration, sweep_speed, path_length = traits
    gesture_manner = MANNERS[gesture]
    press_force = min(press_force, _MAX_PRESSURE * np.pi * contact_radius**2)
    num_frames = int(np.ceil((_TIME_BEFORE + touch_duration + _TIME_AFTER) * rate))
    seconds = np.arange(_FRAME_MULTIPLE * -(-num_frames // _FRAME_MULTIPLE)) / rate
    # Touches begin at a random time between two frames.
    touch_progress = (seconds - _TIME_BEFORE - rng.uniform(0, 1) / rate) / touch_duration
    is_touching = (touch_progress > 0) & (touch_progress < 1)
    touch_progress = np.clip(touch_progress, 0, 1)
    num_sweeps = max(1, round(sweep_speed * touch_duration / path_length)) if gesture_manner.moves else 1
    press_loads = press_force * np.where(is_touching, _relative_loads(rng, touch_progress, gesture, num_sweeps), 0.0)
    sweep_length = path_length if gesture_manner.moves else _MAX_ROLLING_PATH_LENGTH * rng.uniform(0, 1)
    path_centre, path_angle, sweep_length = _random_path(rng, outline, sweep_length)
    path_offsets = (1 - np.abs((num_sweeps * touch_progress) % 2 - 1) - 0.5) * sweep_length
    press_positions = path_centre + path_offsets[:, None] * np.array([np.cos(path_angle), np.sin(path_angle)])
    indenter: DiscIndenter | JoinedIndenters = DiscIndenter(2 * contact_radius)
    if gesture == "scratch":
        fingertip_radius = contact_radius / np.sqrt(_NUM_FINGERTIPS)
        fingertip_offsets = (
            _FINGERTIP_SPACING * fingertip_radius * (np.arange(_NUM_FINGERTIPS) - (_NUM_FINGERTIPS - 1) / 2)
        )
        indenter = JoinedIndenters(
            *(
                PlacedIndenter(DiscIndenter(2 * fingertip_radius), (0.0, fingertip_offset))
                for fingertip_offset in fingertip_offsets
            )
        )
    # The hand may extend over the edge of the skin, but its path lies on the skin.
    return MovingPress(indenter, press_loads, press_positions, path_angle), seconds


def _relative_loads(rng: np.random.Generator, touch_progress: np.ndarray, gesture: str, num_sweeps: int) -> np.ndarray:
    """Compute loads (T,), as fractions of the touch's force, at times `touch_progress` (T,), fractions of its
    duration."""
    if MANNERS[gesture].duration == "short":
        return np.sin(np.pi * touch_progress)
    ramp_factors = np.clip(np.minimum(touch_progress, 1 - touch_progress) / _RAMP_FRACTION, 0, 1)
    relative_loads = np.sin(np.pi / 2 * ramp_factors) ** 2
    fluctuation_cycles, fluctuation_phases = rng.uniform(0.5, 4, 3), rng.uniform(0, 2 * np.pi, 3)
    relative_loads = relative_loads * (
        1
        + _FLUCTUATION_AMPLITUDE
        * np.sin(2 * np.pi * touch_progress[:, None] * fluctuation_cycles + fluctuation_phases).sum(axis=1)
    )
    if gesture == "scratch":
        relative_loads = relative_loads * (
            1
            - _LOAD_REDUCTION_AT_TURNS
            + _LOAD_REDUCTION_AT_TURNS * np.abs(np.sin(np.pi * num_sweeps * touch_progress))
        )
    return relative_loads


def _random_path(rng: np.random.Generator, outline: Domain, path_length: float) -> tuple[np.ndarray, float, float]:
    """Draw the centre, angle and length of a straight path on the skin, shorter than `path_length` if no place is
    found."""
    low_x, high_x, low_y, high_y = map(float, outline.extent)
    while True:
        for _ in range(_NUM_TRIED_PLACES):
            path_centre = rng.uniform((low_x, low_y), (high_x, high_y))
            path_angle = rng.uniform(0, 2 * np.pi)
            half_path_vector = path_length / 2 * np.array([np.cos(path_angle), np.sin(path_angle)])
            path_points = np.stack([path_centre - half_path_vector, path_centre, path_centre + half_path_vector])
            if (np.asarray(outline.signed_distance(path_points)) >= _EDGE_MARGIN).all():
                return path_centre, float(path_angle), path_length
        path_length *= _SHORTENING_FACTOR


# Minimum width and height of a skin for a hand, in metres.
_MIN_SKIN_SIDE = 0.06


class Person(Module):
    """A simulated person, who makes gestures with a force, contact size, duration and speed of their own.

    **Fields**: `medians` (6, 5): medians over the touches of this person, in SI units: force, radius of the contact,
    duration, speed and path (columns) for each of the six gestures (rows).

    **Example:**

    ```python
    person = Person.draw(key)
    motion, times = person.touch(key, "stroke", outline)
    ```
    """

    medians: Float[np.ndarray, "6 5"]

    def __check_init__(self):
        """Check the medians. Raises `ValueError` for other shapes, and for negative or infinite values."""
        check_kind("medians", self.medians, np.ndarray, "an array (6, 5), such as of Person.draw(key)")
        if self.medians.shape != (len(GESTURES), len(TRAITS)):
            raise ValueError(f"medians have shape {self.medians.shape}; give ({len(GESTURES)}, {len(TRAITS)}).")
        if not np.isfinite(self.medians).all() or (self.medians < 0).any():
            raise ValueError("medians must be finite, and zero or more, in SI units.")

    @classmethod
    def draw(cls, key: Array) -> "Person":
        """Draw a random person, whose medians are log-normally distributed about the medians among people of each
        gesture. Raises `ValueError` for an invalid key."""
        check_key(key)
        normal_draws = np.asarray(jax.random.normal(key, (len(GESTURES), len(TRAITS))))
        gesture_manners = MANNERS.values()
        gesture_medians, log_deviations = (
            np.stack([getattr(gesture_manner, statistic_name) for gesture_manner in gesture_manners])
            for statistic_name in ("medians", "spread")
        )
        return cls(gesture_medians * np.exp(log_deviations * normal_draws))

    def touch(
        self, key: Array, gesture: str, outline: Domain, *, rate: float = 60.0
    ) -> tuple[MovingPress, Float[np.ndarray, " T"]]:
        """Simulate a gesture of this person at a random place on a skin with this `outline`.

        Returns the moving press and the times (T,) of its frames, seconds, at `rate` frames/s. The frames begin before
        the touch and end after it. Force, radius, duration, speed and path are log-normally distributed about the
        medians of the person. Raises `ValueError` for invalid arguments, and for a skin too small for a hand.
        """
        check_key(key)
        check_name("gesture", gesture, GESTURES)
        check_kind("outline", outline, Domain, "an outline, such as Rectangle(0.32, 0.2)")
        if not (is_number(rate) and rate > 0):
            raise ValueError(f"rate must be frames per second, positive; it is {describe(rate)}.")
        low_x, high_x, low_y, high_y = map(float, outline.extent)
        if min(high_x - low_x, high_y - low_y) < _MIN_SKIN_SIDE:
            raise ValueError(f"outline must be {1e3 * _MIN_SKIN_SIDE:g} mm wide and high at least, for a hand.")
        rng = np.random.default_rng(np.asarray(jax.random.bits(key, (4,))).tolist())
        trait_log_deviations = MANNERS[gesture].touch_spread * rng.normal(size=len(TRAITS))
        traits = self.medians[GESTURES.index(gesture)] * np.exp(trait_log_deviations)
        return gesture_motion(rng, gesture, traits, outline, float(rate))
