"""Simulate one long recording of gestures, one after another with pauses, as from a skin in use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import check_key, check_kind, describe, is_number
from jeit.mesh import Domain
from jeit.touch.simulate.contact.press import MovingPress
from jeit.touch.simulate.contact.pressed_skin import PressedSkin
from jeit.touch.simulate.people.manners import GESTURES
from jeit.touch.simulate.people.person import Person

# Untouched seconds before the first gesture.
_FIRST = 2.0


@dataclass(frozen=True)
class GestureStream:
    """F frames of M channels: `seconds` (F,), `voltages` (F, M), volts; and of its n touches the `gesture` (n,), whose
    it was, `person` (n,), a number, and when a load began and ended, `onset` and `offset` (n,), seconds."""

    seconds: Float[np.ndarray, " F"]
    voltages: Float[np.ndarray, "F M"]
    gesture: np.ndarray
    person: Int[np.ndarray, " n"]
    onset: Float[np.ndarray, " n"]
    offset: Float[np.ndarray, " n"]


def simulate_gesture_stream(
    key: Array,
    skin: PressedSkin,
    outline: Domain,
    people: Sequence[Person],
    number: int,
    *,
    pause: float = 1.0,
    rate: float = 60.0,
) -> GestureStream:
    """`number` gestures drawn at random, by people drawn at random, on a skin of this `outline` that nobody touches for
    the first two seconds, and between them for `pause` seconds or more; `rate`: frames/s.

    The skin creeps and drifts all the while. Raises `ValueError` for what is no key, skin, person or number, and as
    `Person.touch` and `PressedSkin.record` do.
    """
    check_key(key)
    check_kind("skin", skin, PressedSkin, "a PressedSkin")
    check_kind("people", people, (list, tuple), "a list of them, such as [Person.draw(key)]")
    if not people:
        raise ValueError("people: give one at least, such as [Person.draw(key)].")
    if not (isinstance(number, int) and number >= 1):
        raise ValueError(f"number must be a number of gestures, 1 or more; it is {describe(number)}.")
    if not (is_number(pause) and pause >= 0):
        raise ValueError(f"pause must be seconds, zero or more; it is {describe(pause)}.")
    for_draws, for_touches, for_frames = jax.random.split(key, 3)
    rng = np.random.default_rng(np.asarray(jax.random.bits(for_draws, (4,))).tolist())
    gesture, person = rng.choice(GESTURES, number), rng.integers(len(people), size=number)
    made, first, begin = [], int(_FIRST * rate), []
    for own, one, who in zip(jax.random.split(for_touches, number), gesture, person, strict=True):
        motion, times = people[who].touch(own, str(one), outline, rate=rate)
        made.append(motion)
        begin.append(first)
        first += len(times) + int(rng.uniform(1, 2) * pause * rate)
    seconds = np.arange(first) / rate
    motions, onset, offset = [], [], []
    for motion, start in zip(made, begin, strict=True):
        load, place, angle = np.zeros(first), np.zeros((first, 2)), np.zeros(first)
        own = slice(start, start + len(motion.load))
        load[own], place[own], angle[own] = motion.load, motion.position, motion.angle
        motions.append(MovingPress(motion.indenter, load, place, angle))
        pressed = np.flatnonzero(load)
        onset.append(seconds[pressed[0]] if pressed.size else seconds[start])
        offset.append(seconds[pressed[-1]] if pressed.size else seconds[start])
    voltages = skin.record(for_frames, motions, seconds)
    return GestureStream(seconds, voltages, gesture, person, np.array(onset), np.array(offset))
