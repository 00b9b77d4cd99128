"""A gesture as a moving press: its load, place and angle, frame by frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.mesh import Domain
from jeit.touch.simulate.contact.indenters import Disc
from jeit.touch.simulate.contact.joined import Joined, Placed
from jeit.touch.simulate.contact.press import MovingPress
from jeit.touch.simulate.people.manners import MANNERS

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
