"""Labelled sound clips of many people touching a skin with microphones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.acoustic.simulate.checks import check_positive
from jeit.acoustic.simulate.people.manners import MODALITIES
from jeit.acoustic.simulate.people.sounding_person import SoundingPerson
from jeit.acoustic.simulate.sound import SimulatedSound
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import microphone_noise, sample_times
from jeit.acoustic.simulate.wind_sound import room_sound
from jeit.arguments import check_kind, check_name, describe

# Decibels: level of the room's sound relative to the microphones' own noise, and its deviation between clips.
_ROOM, _ROOM_SPREAD = -6.0, 4.0


@dataclass(frozen=True)
class SoundClip:
    """One clip: the `touch` with its truth, and the `noise` (M, S) added to it; its `modality`, and `person`, a number.
    The recorded sound is `samples`."""

    touch: SimulatedSound
    noise: Float[np.ndarray, "M S"]
    modality: str
    person: int

    @property
    def samples(self) -> Float[np.ndarray, "M S"]:
        """Sum of touch and noise."""
        return self.touch.samples + self.noise

    def noisier(self, decibels: float) -> Float[np.ndarray, "M S"]:
        """Samples of the touch with the noise raised by a number of decibels."""
        return self.touch.samples + 10 ** (decibels / 20) * self.noise


def sound_clips(
    key: Array,
    skin: SoundingSkin,
    people: Sequence[SoundingPerson],
    each: int,
    *,
    modalities: Sequence[str] = MODALITIES,
    duration: float = 2.9,
) -> Iterator[SoundClip]:
    """Yield `each` clips of each modality by each person, in this order, one at a time: a set need not fit into memory.

    Noise is the microphones' own and the room's, normal in decibels about -6 dB of that. Every clip has a key of its
    own. Raises `ValueError` for what is no key, skin, person, modality or number, and no people.
    """
    check_skin_and_key(skin, key)
    check_kind("people", people, (list, tuple), "a list of them, such as [SoundingPerson.draw(key)]")
    for number, person in enumerate(people):
        check_kind(f"people[{number}]", person, SoundingPerson, "a SoundingPerson, such as SoundingPerson.draw(key)")
    if not people:
        raise ValueError("people: give one at least, such as [SoundingPerson.draw(key)].")
    check_kind("modalities", modalities, (list, tuple), "a list of names, such as ['pat', 'none']")
    for number, modality in enumerate(modalities):
        check_name(f"modalities[{number}]", modality, MODALITIES)
    if not (isinstance(each, int) and each >= 1):
        raise ValueError(f"each must be a number of clips, 1 or more; it is {describe(each)}.")
    check_positive("duration", duration)
    return _clips(key, skin, people, each, tuple(modalities), duration)


def _clips(key, skin, people, each, modalities, duration) -> Iterator[SoundClip]:
    count = len(sample_times(skin, duration))
    rows = [(person, modality) for person in range(len(people)) for modality in modalities for _ in range(each)]
    for number, (person, modality) in enumerate(rows):
        touched, own, room, loud = jax.random.split(jax.random.fold_in(key, number), 4)
        touch = people[person].touch(touched, modality, skin, duration=duration)
        level = _ROOM + _ROOM_SPREAD * float(jax.random.normal(loud))
        around = room_sound(skin, room, level_db=level, duration=duration).samples
        yield SoundClip(touch, microphone_noise(skin, own, count) + around, modality, person)
