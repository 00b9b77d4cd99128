"""How six gestures are made by most people: Table I of Silvera Tawil et al. (2011), its words as numbers.

The table has words only: of area, intensity, displacement and duration. What number each stands for is chosen here,
once, from everyday touch, and the same word is the same number in every gesture: a fingertip's contact is 7 mm in
radius, a flat hand's through foam some 20; typing takes 1 N, resting fingers 2, a firm push 10; a knock is there for a
seventh of a second, a caress for a second. A word that spans a range, such as small to large, spreads more from person
to person. For in-plane displacement there is only yes: fingers stroke at some 0.1 m/s along a hand's length, and
scratch to and fro, faster and less far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
