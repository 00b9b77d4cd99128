"""Simulated gestures of many people, as separate recordings or as a stream."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.arguments import check_key, check_kind, check_name, describe, is_number
from jeit.data import GestureSet
from jeit.mesh import Domain
from jeit.touch.simulate.contact.press import MovingPress
from jeit.touch.simulate.contact.pressed_skin import PressedSkin
from jeit.touch.simulate.people.person import GESTURES, Person

# Maximum time since the reference, during which the skin drifts, in seconds; number of frames of the reference; number
# of recordings of the untouched skin, each with its own drift; and number of frames of each.
_LATEST, _REFERENCE, _DRIFTS, _FRAMES = 60.0, 60, 40, 16
# Number of recordings simulated at once.
_AT_ONCE = 120


def simulate_gestures(
    key: Array,
    skin: PressedSkin,
    outline: Domain,
    people: Sequence[Person],
    each: int,
    *,
    gestures: Sequence[str] = GESTURES,
    rate: float = 60.0,
    progress: Callable[[str], None] | None = None,
) -> GestureSet:
    """Simulate recordings of the gestures of people on a skin.

    Before each recording, the skin has drifted for up to a minute since its reference, without load.

    **Arguments:**

    - `key`: random key.
    - `skin`: the skin.
    - `outline`: outline of the skin.
    - `people`: the people.
    - `each`: number of recordings of each gesture by each person.
    - `gestures`: names of the gestures.
    - `rate`: frames/s.
    - `progress`: called with a description of the progress.

    Raises `ValueError` for invalid arguments, and as `Person.touch` and `PressedSkin.record`.

    **Example:**

    ```python
    recordings = simulate_gestures(key, skin, outline, people, 1, gestures=("tap",), rate=15.0)
    print(recordings.gesture, recordings.voltages.shape)
    ```
    """
    check_key(key)
    check_kind("skin", skin, PressedSkin, "a PressedSkin")
    check_kind("people", people, (list, tuple), "a list of them, such as [Person.draw(key)]")
    for number, person in enumerate(people):
        check_kind(f"people[{number}]", person, Person, "a Person, such as of Person.draw(key)")
    if not people:
        raise ValueError("people: give one at least, such as [Person.draw(key)].")
    check_kind("gestures", gestures, (list, tuple), "a list of names, such as ['tap', 'slap']")
    for number, gesture in enumerate(gestures):
        check_name(f"gestures[{number}]", gesture, GESTURES)
    if not (isinstance(each, int) and each >= 1):
        raise ValueError(f"each must be a number of touches, 1 or more; it is {describe(each)}.")
    before, quiet, touched, late = jax.random.split(key, 4)
    reference = skin.record(before, [], np.arange(_REFERENCE) / rate).mean(axis=0)
    later = np.random.default_rng(np.asarray(jax.random.bits(late, (4,))).tolist())
    still = [([], np.arange(_FRAMES) / rate + later.uniform(0, _LATEST)) for _ in range(_DRIFTS)]
    untouched = skin.record_each(quiet, still)
    rows = [(person, gesture) for person in range(len(people)) for gesture in gestures for _ in range(each)]
    seconds, voltages = [], []
    for first in range(0, len(rows), _AT_ONCE):
        made, keys = [], jax.random.split(jax.random.fold_in(touched, first), _AT_ONCE + 1)
        for one, (person, gesture) in zip(keys[1:], rows[first : first + _AT_ONCE], strict=False):
            motion, times = people[person].touch(one, gesture, outline, rate=rate)
            made.append((motion, times + later.uniform(0, _LATEST)))
            seconds.append(times)
        found = skin.record_each(keys[0], made)
        voltages += [one.astype(np.float32) for one in found]
        if progress is not None:
            progress(f"gestures: {len(voltages)} of {len(rows)}")
    return GestureSet(
        gesture=np.array([gesture for _, gesture in rows]),
        person=np.array([person for person, _ in rows]),
        start=np.concatenate([[0], np.cumsum([len(one) for one in seconds])]),
        seconds=np.concatenate(seconds),
        voltages=np.concatenate(voltages),
        reference=reference,
        untouched=np.concatenate(untouched),
    )


# Time before the first gesture, in seconds.
_FIRST = 2.0


@dataclass(frozen=True)
class GestureStream:
    """A stream of F frames of M channels with n touches.

    - `seconds`: (F,), times of the frames.
    - `voltages`: (F, M), volts.
    - `gesture`: (n,), name of the gesture of each touch.
    - `person`: (n,), number of the person who made it.
    - `onset`, `offset`: (n,), first and last time with load of each touch, seconds.
    """

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
    """Simulate a stream of random gestures of random people on a skin.

    The skin is not touched for the first two seconds. It creeps and drifts throughout.

    **Arguments:**

    - `key`: random key.
    - `skin`: the skin.
    - `outline`: outline of the skin.
    - `people`: the people.
    - `number`: number of gestures.
    - `pause`: minimum time between gestures, seconds.
    - `rate`: frames/s.

    Raises `ValueError` for invalid arguments, and as `Person.touch` and `PressedSkin.record`.

    **Example:**

    ```python
    stream = simulate_gesture_stream(key, skin, outline, people, 1, rate=15.0)
    print(stream.gesture, stream.onset, stream.offset)
    ```
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
