"""Simulated people who gesture on a skin: their manners, and their motion.

How six gestures are made by most people: Table I of Silvera Tawil et al. (2011), its words as numbers.

The table has words only: of area, intensity, displacement and duration. What number each stands for is chosen here,
once, from everyday touch, and the same word is the same number in every gesture: a fingertip's contact is 7 mm in
radius, a flat hand's through foam some 20; typing takes 1 N, resting fingers 2, a firm push 10; a knock is there for a
seventh of a second, a caress for a second. A word that spans a range, such as small to large, spreads more from person
to person. For in-plane displacement there is only yes: fingers stroke at some 0.1 m/s along a hand's length, and
scratch to and fro, faster and less far.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.arguments import check_key, check_kind, check_name, describe, is_number
from jeit.mesh import Domain
from jeit.touch.simulate.contact.indenters import Disc
from jeit.touch.simulate.contact.joined import Joined, Placed
from jeit.touch.simulate.contact.press import MovingPress

TRAITS = ("force", "radius", "duration", "speed", "path")
"""Parameters of a touch: force, N; radius of a disc as large as its contact, m; duration, s; and of moving touches
speed, m/s, and path, m, of a sweep."""

# Of each word: the median, and the deviation of its logarithm among people.
_AREA = {"small": (7e-3, 0.2), "sm-large": (12e-3, 0.45), "med-large": (20e-3, 0.3)}
_INTENSITY = {"low": (1.0, 0.3), "low-med": (2.0, 0.4), "med-high": (5.0, 0.4), "high": (10.0, 0.3)}
_DURATION = {"short": (0.15, 0.3), "med-long": (1.2, 0.4)}
_MOVING = 0.35
# Deviation of the logarithm of every trait between touches of one person.
_WITHIN = 0.25


@dataclass(frozen=True)
class Manner:
    """How a gesture is made: the words of Table I for area, intensity and duration.

    Where it moves: also speed, m/s, and path of a sweep, m.
    """

    area: str
    intensity: str
    duration: str
    speed: float = 0.0
    path: float = 0.0

    @property
    def medians(self) -> Float[np.ndarray, " 5"]:
        """Medians of `TRAITS` among people, in SI units; 0 where it does not move."""
        return np.array([*(one[0] for one in self._words), self.speed, self.path])

    @property
    def spread(self) -> Float[np.ndarray, " 5"]:
        """Deviations of the logarithms of `TRAITS` among people."""
        return np.array([*(one[1] for one in self._words), _MOVING, _MOVING])

    @property
    def within(self) -> float:
        """Deviation of their logarithms between touches of one person."""
        return _WITHIN

    @property
    def moves(self) -> bool:
        """Whether it is displaced in the plane."""
        return self.path > 0

    @property
    def _words(self) -> tuple[tuple[float, float], ...]:
        return _INTENSITY[self.intensity], _AREA[self.area], _DURATION[self.duration]


MANNERS: dict[str, Manner] = {
    "tap": Manner("small", "low", "short"),
    "pat": Manner("med-large", "low-med", "short"),
    "push": Manner("sm-large", "high", "med-long"),
    "stroke": Manner("med-large", "low-med", "med-long", speed=0.1, path=0.12),
    "scratch": Manner("sm-large", "med-high", "med-long", speed=0.2, path=0.05),
    "slap": Manner("med-large", "high", "short"),
}
"""The six gestures, in the paper's order."""

GESTURES = tuple(MANNERS)
"""Names of the gestures."""


# Seconds recorded before a touch, and the least after it; the number of frames is a multiple of the last.
_BEFORE, _AFTER, _EVEN = 0.1, 0.5, 16
# Pascals, more than a hand's pressure; metres of a hand's middle from the skin's edge, at least; metres that a hand
# rolls which stays where it is; shares of a long touch in which its load comes and goes; how much a load wobbles.
_MOST_PRESSURE, _MARGIN, _ROLL, _RAMP, _WOBBLE = 120e3, 15e-3, 2e-3, 0.15, 0.08
# The number of fingertips that scratch, and their distance over their radius; the reduction of their load where they
# turn.
_TIPS, _APART, _LIGHTER = 3, 2.6, 0.4
# The number of places tried until a path lies on the skin, before it is made shorter, by this factor.
_TRIES, _SHORTER = 20, 0.8


def gesture_motion(
    rng: np.random.Generator, gesture: str, traits: Float[np.ndarray, " 5"], outline: Domain, rate: float
) -> tuple[MovingPress, Float[np.ndarray, " T"]]:
    """A gesture with these traits (`TRAITS`, SI units) anywhere on the skin, and the times of its frames, seconds, at
    `rate` frames/s, from 0.1 s before it to 0.5 s after it, as the skin recovers late."""
    force, radius, duration, speed, path = traits
    manner = MANNERS[gesture]
    force = min(force, _MOST_PRESSURE * np.pi * radius**2)
    frames = int(np.ceil((_BEFORE + duration + _AFTER) * rate))
    seconds = np.arange(_EVEN * -(-frames // _EVEN)) / rate
    # Frames are not synchronised with touches.
    share = (seconds - _BEFORE - rng.uniform(0, 1) / rate) / duration
    within = (share > 0) & (share < 1)
    share = np.clip(share, 0, 1)
    sweeps = max(1, round(speed * duration / path)) if manner.moves else 1
    load = force * np.where(within, _loads(rng, share, gesture, sweeps), 0.0)
    length = path if manner.moves else _ROLL * rng.uniform(0, 1)
    middle, angle, length = _somewhere(rng, outline, length)
    along = (1 - np.abs((sweeps * share) % 2 - 1) - 0.5) * length
    place = middle + along[:, None] * np.array([np.cos(angle), np.sin(angle)])
    indenter: Disc | Joined = Disc(2 * radius)
    if gesture == "scratch":
        tip = radius / np.sqrt(_TIPS)
        offsets = _APART * tip * (np.arange(_TIPS) - (_TIPS - 1) / 2)
        indenter = Joined(*(Placed(Disc(2 * tip), (0.0, offset)) for offset in offsets))
    # A hand may lie across the edge, but not beside the skin.
    return MovingPress(indenter, load, place, angle), seconds


def _loads(rng: np.random.Generator, share: np.ndarray, gesture: str, sweeps: int) -> np.ndarray:
    """Load relative to its maximum, at shares of the duration."""
    if MANNERS[gesture].duration == "short":
        return np.sin(np.pi * share)
    ramp = np.clip(np.minimum(share, 1 - share) / _RAMP, 0, 1)
    load = np.sin(np.pi / 2 * ramp) ** 2
    cycles, phase = rng.uniform(0.5, 4, 3), rng.uniform(0, 2 * np.pi, 3)
    load = load * (1 + _WOBBLE * np.sin(2 * np.pi * share[:, None] * cycles + phase).sum(axis=1))
    if gesture == "scratch":
        load = load * (1 - _LIGHTER + _LIGHTER * np.abs(np.sin(np.pi * sweeps * share)))
    return load


def _somewhere(rng: np.random.Generator, outline: Domain, length: float) -> tuple[np.ndarray, float, float]:
    """Middle, angle and length of a straight path on the skin; a shorter one where none of the length is found."""
    low_x, high_x, low_y, high_y = map(float, outline.extent)
    while True:
        for _ in range(_TRIES):
            middle = rng.uniform((low_x, low_y), (high_x, high_y))
            angle = rng.uniform(0, 2 * np.pi)
            half = length / 2 * np.array([np.cos(angle), np.sin(angle)])
            ends = np.stack([middle - half, middle, middle + half])
            if (np.asarray(outline.signed_distance(ends)) >= _MARGIN).all():
                return middle, float(angle), length
        length *= _SHORTER


# Least distance, metres, of a hand's centre from the edge; a skin has room for it.
_LEAST_SIDE = 0.06


class Person(eqx.Module):
    """How one person makes the six gestures: the medians (6, 5) of `TRAITS` of their touches, `GESTURES` in rows."""

    medians: Float[np.ndarray, "6 5"]

    def __check_init__(self):
        """Raises `ValueError` for other shapes, and what is negative or not finite."""
        check_kind("medians", self.medians, np.ndarray, "an array (6, 5), such as of Person.draw(key)")
        if self.medians.shape != (len(GESTURES), len(TRAITS)):
            raise ValueError(f"medians have shape {self.medians.shape}; give ({len(GESTURES)}, {len(TRAITS)}).")
        if not np.isfinite(self.medians).all() or (self.medians < 0).any():
            raise ValueError("medians must be finite, and zero or more, in SI units.")

    @classmethod
    def draw(cls, key: Array) -> "Person":
        """Draw a person: medians are log-normal about those of each gesture. Raises `ValueError` for what is no key."""
        check_key(key)
        normal = np.asarray(jax.random.normal(key, (len(GESTURES), len(TRAITS))))
        manners = MANNERS.values()
        medians, spread = (np.stack([getattr(one, name) for one in manners]) for name in ("medians", "spread"))
        return cls(medians * np.exp(spread * normal))

    def touch(
        self, key: Array, gesture: str, outline: Domain, *, rate: float = 60.0
    ) -> tuple[MovingPress, Float[np.ndarray, " T"]]:
        """Simulate a gesture by this person anywhere on a skin of this `outline`.

        Returns the press, and the times (T,) of its frames, seconds, at `rate` frames/s, some before and after it.
        Traits are log-normal about the person's own. Raises `ValueError` for what is no key, gesture, outline or rate,
        and a skin too small for a hand.
        """
        check_key(key)
        check_name("gesture", gesture, GESTURES)
        check_kind("outline", outline, Domain, "an outline, such as Rectangle(0.32, 0.2)")
        if not (is_number(rate) and rate > 0):
            raise ValueError(f"rate must be frames per second, positive; it is {describe(rate)}.")
        low_x, high_x, low_y, high_y = map(float, outline.extent)
        if min(high_x - low_x, high_y - low_y) < _LEAST_SIDE:
            raise ValueError(f"outline must be {1e3 * _LEAST_SIDE:g} mm wide and high at least, for a hand.")
        rng = np.random.default_rng(np.asarray(jax.random.bits(key, (4,))).tolist())
        own = MANNERS[gesture].within * rng.normal(size=len(TRAITS))
        traits = self.medians[GESTURES.index(gesture)] * np.exp(own)
        return gesture_motion(rng, gesture, traits, outline, float(rate))
