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
from jeit.touch.simulate.contact.pressed_skin import PressedSkin, split_keys
from jeit.touch.simulate.people.person import GESTURES, Person

# Maximum time since the reference frame, during which the skin drifts, in seconds.
_MAX_DRIFT_TIME = 60.0
# Number of frames of which the reference is the mean.
_NUM_REFERENCE_FRAMES = 60
# Number of recordings of the untouched skin, each with its own drift.
_NUM_UNTOUCHED_RECORDINGS = 40
# Number of frames of each recording of the untouched skin.
_NUM_UNTOUCHED_FRAMES = 16
# Number of recordings simulated at once.
_RECORDINGS_AT_ONCE = 120


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

    Before each recording, the skin has drifted for up to a minute since its reference frame, without load.

    **Arguments:**

    - `key`: random key.
    - `skin`: the skin.
    - `outline`: outline of the skin.
    - `people`: the people who touch the skin.
    - `each`: number of recordings of each gesture by each person.
    - `gestures`: names of the gestures.
    - `rate`: frame rate, frames/s.
    - `progress`: function that is called with a description of the progress.

    Raises `ValueError` for invalid arguments, and as `Person.touch` and `PressedSkin.record` do.

    **Example:**

    ```python
    recordings = simulate_gestures(key, skin, outline, people, 1, gestures=("tap",), rate=15.0)
    print(recordings.gesture, recordings.voltages.shape)
    ```
    """
    check_key(key)
    check_kind("skin", skin, PressedSkin, "a PressedSkin")
    check_kind("people", people, (list, tuple), "a list of them, such as [Person.draw(key)]")
    for person_index, person in enumerate(people):
        check_kind(f"people[{person_index}]", person, Person, "a Person, such as of Person.draw(key)")
    if not people:
        raise ValueError("people: give one at least, such as [Person.draw(key)].")
    check_kind("gestures", gestures, (list, tuple), "a list of names, such as ['tap', 'slap']")
    for person_index, gesture in enumerate(gestures):
        check_name(f"gestures[{person_index}]", gesture, GESTURES)
    if not (isinstance(each, int) and each >= 1):
        raise ValueError(f"each must be a number of touches, 1 or more; it is {describe(each)}.")
    reference_key, untouched_key, touch_key, time_key = jax.random.split(key, 4)
    reference_voltages = skin.record(reference_key, [], np.arange(_NUM_REFERENCE_FRAMES) / rate).mean(axis=0)
    random_generator = np.random.default_rng(np.asarray(jax.random.bits(time_key, (4,))).tolist())
    untouched_motions = [
        ([], np.arange(_NUM_UNTOUCHED_FRAMES) / rate + random_generator.uniform(0, _MAX_DRIFT_TIME))
        for _ in range(_NUM_UNTOUCHED_RECORDINGS)
    ]
    untouched_voltages = skin.record_each(untouched_key, untouched_motions)
    person_gesture_pairs = [
        (person, gesture) for person in range(len(people)) for gesture in gestures for _ in range(each)
    ]
    seconds, voltages = [], []
    for first_row in range(0, len(person_gesture_pairs), _RECORDINGS_AT_ONCE):
        motions_and_times, row_keys = (
            [],
            split_keys(jax.random.fold_in(touch_key, first_row), _RECORDINGS_AT_ONCE + 1),
        )
        for row_key, (person, gesture) in zip(
            row_keys[1:], person_gesture_pairs[first_row : first_row + _RECORDINGS_AT_ONCE], strict=False
        ):
            motion, motion_times = people[person].touch(row_key, gesture, outline, rate=rate)
            motions_and_times.append((motion, motion_times + random_generator.uniform(0, _MAX_DRIFT_TIME)))
            seconds.append(motion_times)
        recordings = skin.record_each(row_keys[0], motions_and_times)
        voltages += [recorded_voltages.astype(np.float32) for recorded_voltages in recordings]
        if progress is not None:
            progress(f"gestures: {len(voltages)} of {len(person_gesture_pairs)}")
    return GestureSet(
        gesture=np.array([gesture for _, gesture in person_gesture_pairs]),
        person=np.array([person for person, _ in person_gesture_pairs]),
        start=np.concatenate([[0], np.cumsum([len(motion_times) for motion_times in seconds])]),
        seconds=np.concatenate(seconds),
        voltages=np.concatenate(voltages),
        reference=reference_voltages,
        untouched=np.concatenate(untouched_voltages),
    )


# Time before the first gesture of a stream, in seconds.
_TIME_BEFORE_FIRST = 2.0


@dataclass(frozen=True)
class GestureStream:
    """A simulated stream of F frames of M channels with n touches.

    - `seconds`: (F,), times of the frames.
    - `voltages`: (F, M), volts.
    - `gesture`: (n,), name of the gesture of each touch.
    - `person`: (n,), number of the person who made the touch.
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

    The skin is not touched for the first two seconds. Creep and drift of the skin continue through the whole stream.

    **Arguments:**

    - `key`: random key.
    - `skin`: the skin.
    - `outline`: outline of the skin.
    - `people`: the people who touch the skin.
    - `number`: number of gestures.
    - `pause`: minimum time between gestures, seconds.
    - `rate`: frame rate, frames/s.

    Raises `ValueError` for invalid arguments, and as `Person.touch` and `PressedSkin.record` do.

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
    draw_key, touch_key, frame_key = jax.random.split(key, 3)
    rng = np.random.default_rng(np.asarray(jax.random.bits(draw_key, (4,))).tolist())
    gestures, person_indices = rng.choice(GESTURES, number), rng.integers(len(people), size=number)
    touch_motions, next_frame, first_frames = [], int(_TIME_BEFORE_FIRST * rate), []
    for motion_key, gesture, person_index in zip(split_keys(touch_key, number), gestures, person_indices, strict=True):
        motion, motion_times = people[person_index].touch(motion_key, str(gesture), outline, rate=rate)
        touch_motions.append(motion)
        first_frames.append(next_frame)
        next_frame += len(motion_times) + int(rng.uniform(1, 2) * pause * rate)
    seconds = np.arange(next_frame) / rate
    motions, onset_times, offset_times = [], [], []
    for motion, first_frame in zip(touch_motions, first_frames, strict=True):
        frame_loads, frame_positions, frame_angles = (
            np.zeros(next_frame),
            np.zeros((next_frame, 2)),
            np.zeros(next_frame),
        )
        touch_frames = slice(first_frame, first_frame + len(motion.load))
        frame_loads[touch_frames], frame_positions[touch_frames], frame_angles[touch_frames] = (
            motion.load,
            motion.position,
            motion.angle,
        )
        motions.append(MovingPress(motion.indenter, frame_loads, frame_positions, frame_angles))
        pressed_frames = np.flatnonzero(frame_loads)
        onset_times.append(seconds[pressed_frames[0]] if pressed_frames.size else seconds[first_frame])
        offset_times.append(seconds[pressed_frames[-1]] if pressed_frames.size else seconds[first_frame])
    voltages = skin.record(frame_key, motions, seconds)
    return GestureStream(seconds, voltages, gestures, person_indices, np.array(onset_times), np.array(offset_times))
