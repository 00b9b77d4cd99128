"""Simulation of people with individual traits who pat, tickle, stroke and blow on a skin with microphones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jeit.acoustic.simulate.sound import (
    FIRST_BURST_TIME,
    SOURCE_POSITION_INTERVAL,
    Burst,
    SimulatedSound,
    block_times,
    microphone_noise,
    sample_times,
    simulate_recording,
    simulate_silence,
)
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.touch_sounds import NOMINAL_SPEED
from jeit.acoustic.simulate.wind_sound import KOLMOGOROV_EXPONENT, simulate_room_sound, simulate_wind
from jeit.arguments import check_key, check_kind, check_name, describe
from jeit.arguments.checks import check_positive
from jeit_solvers.module import Module

# Standard deviation of the logarithm of a trait between the clips of one person; and standard deviation of the trait
# `slope` itself between people. The standard deviation of `slope` between the clips of one person is half as large.
WITHIN_PERSON_LOG_DEVIATION, SPECTRAL_SLOPE_DEVIATION = 0.25, 0.3


@dataclass(frozen=True)
class TraitDistribution:
    """Distribution of a trait of touches among people.

    **Fields**: `median`: median of the trait in SI units; `spread`: standard deviation of the trait's logarithm, or of
    the trait itself for `slope`.
    """

    median: float
    spread: float


SOUND_MANNERS: dict[str, dict[str, TraitDistribution]] = {
    "pat": {
        "strength": TraitDistribution(2.0, 0.4),
        "length": TraitDistribution(0.08, 0.25),
        "interval": TraitDistribution(0.3, 0.3),
        "slope": TraitDistribution(1.5, SPECTRAL_SLOPE_DEVIATION),
    },
    "tickle": {
        "strength": TraitDistribution(0.7, 0.4),
        "length": TraitDistribution(0.04, 0.25),
        "interval": TraitDistribution(1 / 15, 0.3),
        "radius": TraitDistribution(0.01, 0.3),
        "slope": TraitDistribution(1.0, SPECTRAL_SLOPE_DEVIATION),
    },
    "stroke": {
        "strength": TraitDistribution(1.0, 0.4),
        "speed": TraitDistribution(0.1, 0.35),
        "path": TraitDistribution(0.12, 0.35),
        "slope": TraitDistribution(0.7, SPECTRAL_SLOPE_DEVIATION),
    },
    "wind": {
        "strength": TraitDistribution(1.0, 0.4),
        "radius": TraitDistribution(0.03, 0.3),
        "gusts": TraitDistribution(0.15, 0.4),
        "slope": TraitDistribution(KOLMOGOROV_EXPONENT, SPECTRAL_SLOPE_DEVIATION),
    },
    "none": {},
}
"""Traits of each touch modality. In the modality "none" nobody touches the skin."""

MODALITIES = tuple(SOUND_MANNERS)
"""Names of the touch modalities, in the order of Park 2022."""


# Standard deviations between the taps of one clip: of the logarithm of the strength, and of the logarithm of the
# interval between taps; and maximum distance in metres of a pat from the mean position of the pats.
_TAP_STRENGTH_LOG_DEVIATION, _TAP_INTERVAL_LOG_DEVIATION, _PAT_RADIUS = 0.25, 0.12, 4e-3
# Minimum distance of the centre of a touch from the edge of the skin, in metres.
_EDGE_MARGIN = 0.02
# Minimum speed of a stroking hand at a turn, divided by the hand's mean speed.
_MIN_SPEED_RATIO = 0.1
# Minimum length of a burst of sound in seconds, which limits random lengths.
_MIN_BURST_LENGTH = 0.01


class SoundingPerson(Module):
    """A simulated person, with individual traits of touch.

    **Fields**: `medians`: for each modality of touch, a dictionary from the name of each trait to the person's median
    value, in SI units.

    **Example:**

    ```python
    person = SoundingPerson.draw(key)
    touch = person.touch(key, "stroke", skin, duration=2.0)
    ```
    """

    medians: Mapping[str, Mapping[str, float]] = eqx.field(static=True)

    def __check_init__(self):
        """Raises `ValueError` if the names of the traits are not those in `SOUND_MANNERS`, or the traits are not
        positive numbers."""
        check_kind("medians", self.medians, Mapping, "traits by modality, such as of SoundingPerson.draw(key)")
        for modality_name, trait_names in SOUND_MANNERS.items():
            if set(self.medians.get(modality_name, {})) != set(trait_names):
                raise ValueError(f"medians['{modality_name}'] must have {', '.join(trait_names) or 'no traits'}.")
            for trait_name, trait_median in self.medians[modality_name].items():
                check_positive(f"medians['{modality_name}']['{trait_name}']", trait_median)

    @classmethod
    def draw(cls, key: Array) -> "SoundingPerson":
        """Draw a random person. Traits are log-normally distributed about the medians of the population; the trait
        `slope` is normally distributed. Raises `ValueError` if `key` is not a random key."""
        check_key(key)
        rng = _numpy_generator(key)
        medians = {}
        for modality_name, trait_distributions in SOUND_MANNERS.items():
            medians[modality_name] = {}
            for trait_name, trait_distribution in trait_distributions.items():
                normal_draw = rng.normal()
                if trait_name == "slope":
                    medians[modality_name][trait_name] = max(
                        trait_distribution.median + trait_distribution.spread * normal_draw, 0.1
                    )
                else:
                    medians[modality_name][trait_name] = float(
                        trait_distribution.median * np.exp(trait_distribution.spread * normal_draw)
                    )
        return cls(medians)

    def touch(self, key: Array, modality: str, skin: SoundingSkin, *, duration: float = 2.9) -> SimulatedSound:
        """Simulate `duration` seconds of a touch of this person at a random position on the skin, without noise.

        `modality`: one of `MODALITIES`. The traits of the touch are log-normally distributed about the person's traits,
        and their logarithms have the standard deviation 0.25; the trait `slope` is normally distributed. Raises
        `ValueError` for invalid arguments.
        """
        check_skin_and_key(skin, key)
        check_name("modality", modality, MODALITIES)
        check_positive("duration", duration)
        trait_key, sound_key = jax.random.split(key)
        rng = _numpy_generator(trait_key)
        if modality == "none":
            return _simulate_no_touch(skin, duration)
        trait_values = {}
        for trait_name, trait_median in self.medians[modality].items():
            if trait_name == "slope":
                trait_values[trait_name] = max(trait_median + SPECTRAL_SLOPE_DEVIATION / 2 * rng.normal(), 0.1)
            else:
                trait_values[trait_name] = float(trait_median * np.exp(WITHIN_PERSON_LOG_DEVIATION * rng.normal()))
        # The touch is simulated with its own spectral slope in place of the skin's slope. The microphones' noise
        # depends on the skin's slope, and is therefore not added here.
        sloped_skin = eqx.tree_at(lambda skin_to_change: skin_to_change.spectral_slope, skin, trait_values.pop("slope"))
        return _SIMULATION_FUNCTIONS[modality](rng, sloped_skin, sound_key, trait_values, duration)


def _simulate_taps(
    rng: np.random.Generator, skin: SoundingSkin, key: Array, trait_values: dict, duration: float
) -> SimulatedSound:
    """Simulate a pat or a tickle: taps of random strength and rhythm at random positions within a small disc."""
    tap_burst = Burst(trait_values["strength"], max(trait_values["length"], _MIN_BURST_LENGTH))
    mean_interval, disc_radius = trait_values["interval"], trait_values.get("radius", _PAT_RADIUS)
    num_taps = int(np.ceil(2 * duration / mean_interval)) + 2
    tap_intervals = mean_interval * np.exp(_TAP_INTERVAL_LOG_DEVIATION * rng.normal(size=num_taps))
    # The recording begins at a random phase of the rhythm.
    tap_onsets = FIRST_BURST_TIME - rng.uniform(0, mean_interval) + np.cumsum(tap_intervals) - tap_intervals[0]
    tap_onsets = tap_onsets[(tap_onsets > -tap_burst.length) & (tap_onsets < duration)]
    tap_strengths = tap_burst.strength * np.exp(_TAP_STRENGTH_LOG_DEVIATION * rng.normal(size=len(tap_onsets)))
    sampling_times = sample_times(skin, duration)
    tap_distances = disc_radius * np.sqrt(rng.uniform(size=len(tap_onsets)))
    tap_angles = rng.uniform(0, 2 * np.pi, len(tap_onsets))
    tap_positions = _clip_to_skin(
        skin,
        _random_position(rng, skin)
        + np.stack([tap_distances * np.cos(tap_angles), tap_distances * np.sin(tap_angles)], axis=-1),
    )
    tap_of_block = np.maximum(
        np.searchsorted(tap_onsets, block_times(skin, len(sampling_times)) + SOURCE_POSITION_INTERVAL, side="right")
        - 1,
        0,
    )
    return simulate_recording(
        skin, key, tap_positions[tap_of_block], tap_burst.envelope(sampling_times, tap_onsets, tap_strengths), False
    )


def _simulate_stroke(
    rng: np.random.Generator, skin: SoundingSkin, key: Array, trait_values: dict, duration: float
) -> SimulatedSound:
    """Simulate a stroke back and forth along a straight path, slower at the turns."""
    path_angle, stroke_phase = rng.uniform(0, 2 * np.pi, 2)
    half_displacement = trait_values["path"] / 2 * np.array([np.cos(path_angle), np.sin(path_angle)])
    max_coordinates = np.array([skin.layer.width, skin.layer.height]) / 2 - _EDGE_MARGIN
    half_displacement = half_displacement * min(
        1.0, float(np.min(max_coordinates / np.maximum(np.abs(half_displacement), 1e-9)))
    )
    path_length = 2 * float(np.linalg.norm(half_displacement))
    path_centre = np.clip(
        _random_position(rng, skin),
        -(max_coordinates - np.abs(half_displacement)),
        max_coordinates - np.abs(half_displacement),
    )
    sampling_times = sample_times(skin, duration)
    # The mean speed of a sinusoidal motion of peak-to-peak length L and angular frequency w is L w / π.
    angular_frequency = np.pi * trait_values["speed"] / path_length
    finger_speed = np.maximum(
        path_length / 2 * angular_frequency * np.abs(np.cos(angular_frequency * sampling_times + stroke_phase)),
        _MIN_SPEED_RATIO * trait_values["speed"],
    )
    block_centres = block_times(skin, len(sampling_times))
    source_positions = _clip_to_skin(
        skin, path_centre + np.sin(angular_frequency * block_centres + stroke_phase)[:, None] * half_displacement
    )
    return simulate_recording(
        skin, key, source_positions, trait_values["strength"] * np.sqrt(finger_speed / NOMINAL_SPEED), False
    )


def _simulate_wind(
    rng: np.random.Generator, skin: SoundingSkin, key: Array, trait_values: dict, duration: float
) -> SimulatedSound:
    """Simulate an air jet that blows on a random position of the skin."""
    return simulate_wind(
        skin,
        key,
        _random_position(rng, skin),
        slope=skin.spectral_slope,
        duration=duration,
        noise=False,
        **trait_values,
    )


_SIMULATION_FUNCTIONS: dict[str, Callable[..., SimulatedSound]] = {
    "pat": _simulate_taps,
    "tickle": _simulate_taps,
    "stroke": _simulate_stroke,
    "wind": _simulate_wind,
}


def _simulate_no_touch(skin: SoundingSkin, duration: float) -> SimulatedSound:
    """Simulate a recording without a touch and without noise."""
    silent_recording = simulate_silence(skin, jax.random.key(0), duration=duration)
    return SimulatedSound(
        np.zeros_like(silent_recording.samples),
        skin.rate,
        np.zeros((0, 2)),
        np.zeros(0),
        silent_recording.active,
        False,
    )


def _random_position(rng: np.random.Generator, skin: SoundingSkin) -> np.ndarray:
    """Draw a position (2,) in metres from a uniform distribution on the skin, away from its edges."""
    half_skin_size = np.array([skin.layer.width, skin.layer.height]) / 2
    return rng.uniform(-1, 1, 2) * np.maximum(half_skin_size - _EDGE_MARGIN, half_skin_size / 2)


def _clip_to_skin(skin: SoundingSkin, source_positions: np.ndarray) -> np.ndarray:
    half_skin_size = np.array([skin.layer.width, skin.layer.height]) / 2
    return np.clip(source_positions, -half_skin_size, half_skin_size)


def _numpy_generator(random_key: Array) -> np.random.Generator:
    return np.random.default_rng(np.asarray(jax.random.bits(random_key, (4,))).tolist())


# Mean level of the room's sound relative to the microphones' noise, and its standard deviation between clips, in
# decibels.
_MEAN_ROOM_LEVEL_DB, _ROOM_LEVEL_DEVIATION_DB = -6.0, 4.0


@dataclass(frozen=True)
class SoundClip:
    """Simulated recording of one touch by one person.

    **Fields**: `touch`: noiseless sound of the touch, which also holds the true position of the source; `noise`: noise
    (M, S) of the microphones and the room; `modality`: name of the kind of touch; `person`: index of the person. The
    property `samples` is the recorded sound.
    """

    touch: SimulatedSound
    noise: Float[np.ndarray, "M S"]
    modality: str
    person: int

    @property
    def samples(self) -> Float[np.ndarray, "M S"]:
        """Recorded samples (M, S): the sum of the touch's sound and the noise."""
        return self.touch.samples + self.noise

    def with_louder_noise(self, decibels: float) -> Float[np.ndarray, "M S"]:
        """Return the recorded samples (M, S) with the level of the noise raised by a number of decibels."""
        return self.touch.samples + 10 ** (decibels / 20) * self.noise


def simulate_sound_clips(
    key: Array,
    skin: SoundingSkin,
    people: Sequence[SoundingPerson],
    each: int,
    *,
    modalities: Sequence[str] = MODALITIES,
    duration: float = 2.9,
) -> Iterator[SoundClip]:
    """Yield recordings of touches by several people, ordered by person and modality. Recordings (clips) are generated
    one at a time, so that a large set need not fit into memory.

    The noise consists of the microphones' noise and the room's sound. The level of the room's sound in decibels,
    relative to the microphones' noise, is normally distributed with a mean of -6 dB. Every clip has its own random key.

    **Arguments:**

    - `key`: random key.
    - `skin`: the simulated skin.
    - `people`: the people, as returned by `SoundingPerson.draw`.
    - `each`: number of clips of each modality by each person.
    - `modalities`: kinds of touch: "pat", "tickle", "stroke", "wind" and "none".
    - `duration`: duration of a clip, seconds.

    Raises `ValueError` for invalid arguments, and for an empty list of people.

    **Example:**

    ```python
    people = [SoundingPerson.draw(key)]
    clips = list(simulate_sound_clips(key, skin, people, 1, modalities=("pat", "stroke")))
    ```
    """
    check_skin_and_key(skin, key)
    check_kind("people", people, (list, tuple), "a list of them, such as [SoundingPerson.draw(key)]")
    for person_index, person in enumerate(people):
        check_kind(
            f"people[{person_index}]", person, SoundingPerson, "a SoundingPerson, such as SoundingPerson.draw(key)"
        )
    if not people:
        raise ValueError("people: give one at least, such as [SoundingPerson.draw(key)].")
    check_kind("modalities", modalities, (list, tuple), "a list of names, such as ['pat', 'none']")
    for person_index, modality in enumerate(modalities):
        check_name(f"modalities[{person_index}]", modality, MODALITIES)
    if not (isinstance(each, int) and each >= 1):
        raise ValueError(f"each must be a number of clips, 1 or more; it is {describe(each)}.")
    check_positive("duration", duration)
    return _generate_clips(key, skin, people, each, tuple(modalities), duration)


def _generate_clips(random_key, skin, people, num_clips_per_label, modalities, duration) -> Iterator[SoundClip]:
    num_samples = len(sample_times(skin, duration))
    clip_labels = [
        (person_index, modality)
        for person_index in range(len(people))
        for modality in modalities
        for _ in range(num_clips_per_label)
    ]
    for clip_index, (person_index, modality) in enumerate(clip_labels):
        touch_key, noise_key, room_key, level_key = jax.random.split(jax.random.fold_in(random_key, clip_index), 4)
        touch_recording = people[person_index].touch(touch_key, modality, skin, duration=duration)
        room_level_db = _MEAN_ROOM_LEVEL_DB + _ROOM_LEVEL_DEVIATION_DB * float(jax.random.normal(level_key))
        room_samples = simulate_room_sound(skin, room_key, level_db=room_level_db, duration=duration).samples
        yield SoundClip(
            touch_recording, microphone_noise(skin, noise_key, num_samples) + room_samples, modality, person_index
        )
