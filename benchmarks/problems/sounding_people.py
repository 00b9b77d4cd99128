"""People on the simulated skin of Park et al. (2022): windows of sound, with more noise and with fewer microphones.

The skin has 25 microphones under 200 × 200 × 10 mm, sampled at 10 kHz. The differences between people, and their
loudness relative to the noise, are in `jeit.acoustic.simulate.people`, fixed before accuracies were computed.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from jeit.acoustic import Recording
from jeit.acoustic.simulate import SoundingPerson, SoundingSkin, simulate_sound_clips
from jeit.acoustic.simulate.people import MODALITIES, SOUND_MANNERS
from jeit.touch.listening import SoundImages, sound_images

# Decibels of additional noise, and the microphones that are used of the skin's 5 × 5: all, every other microphone of
# the grid, the four diagonal neighbours of the centre, and the microphone at the centre.
LOUDER = (0.0, 5.0, 10.0, 15.0, 20.0)
FEWER = {25: tuple(range(25)), 9: (0, 2, 4, 10, 12, 14, 20, 22, 24), 4: (6, 8, 16, 18), 1: (12,)}
# Every other window of a clip is used, 0.2 s apart: the windows between them share most of their sound.
_EVERY = 2
# Version of stored sets, which must be increased when the simulation changes.
_VERSION = 1


@dataclass(frozen=True)
class SoundSet:
    """W windows of sound. `images`: sound images by decibels of additional noise and number of microphones.

    `right` (W,), `person` (W,), `clip` (W,): indices of each window's class in `MODALITIES`, of its person and of its
    clip.
    """

    images: dict[tuple[float, int], SoundImages]
    right: np.ndarray
    person: np.ndarray
    clip: np.ndarray


def sound_set(people: int, each: int, seed: int, *, store: Path | None = None) -> SoundSet:
    """Sound set of `each` clips of every modality by `people` persons drawn from `seed`; clips are 2.9 s long.

    The set is read from the folder `store` if it exists there, otherwise simulated and written there.
    """
    decides = people, each, seed, SOUND_MANNERS, LOUDER, FEWER, _EVERY, _VERSION
    path = None if store is None else store / f"sounds-{hashlib.sha256(repr(decides).encode()).hexdigest()[:12]}.npz"
    if path is None or not path.exists():
        made = _simulated(people, each, seed)
        if path is None:
            return made
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {"right": made.right, "person": made.person, "clip": made.clip}
        for (louder, number), images in made.images.items():
            arrays |= {f"{louder:g} {number} {name}": getattr(images, name) for name in images.__dataclass_fields__}
        np.savez(path, **arrays)
        return made
    with np.load(path) as held:
        images = {
            (louder, number): SoundImages(
                *(held[f"{louder:g} {number} {name}"] for name in SoundImages.__dataclass_fields__)
            )
            for louder, number in _variants()
        }
        return SoundSet(images, held["right"], held["person"], held["clip"])


def _variants() -> list[tuple[float, int]]:
    return [(louder, 25) for louder in LOUDER] + [(0.0, number) for number in FEWER if number < 25]


def _simulated(people: int, each: int, seed: int) -> SoundSet:
    skin = SoundingSkin(jax.random.key(0))
    for_people, for_clips = jax.random.split(jax.random.key(seed))
    drawn = [SoundingPerson.draw(key) for key in jax.random.split(for_people, people)]
    parts: dict[tuple[float, int], list[SoundImages]] = {one: [] for one in _variants()}
    right, person = [], []
    for clip in simulate_sound_clips(for_clips, skin, drawn, each):
        for louder, number in parts:
            received = clip.with_louder_noise(louder)[list(FEWER[number])]
            parts[louder, number].append(sound_images(Recording(received, skin.rate))[::_EVERY])
        right.append(MODALITIES.index(clip.modality))
        person.append(clip.person)
    count = len(parts[0.0, 25][0])
    return SoundSet(
        {one: SoundImages.concatenate(own) for one, own in parts.items()},
        np.repeat(right, count),
        np.repeat(person, count),
        np.repeat(np.arange(len(right)), count),
    )
