"""Simulated people on a skin with microphones: individual pats, tickles, strokes and wind, which vary between
touches."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from jeit.acoustic.simulate.bursts import ONSET, Burst
from jeit.acoustic.simulate.checks import check_positive
from jeit.acoustic.simulate.people.manners import MODALITIES, SLOPE_AMONG, SOUND_MANNERS, WITHIN
from jeit.acoustic.simulate.sound import HOP, SimulatedSound, block_times, quiet, record
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import sample_times
from jeit.acoustic.simulate.touches import NOMINAL_SPEED
from jeit.acoustic.simulate.wind_sound import wind
from jeit.arguments import check_key, check_kind, check_name

# From tap to tap of one clip, deviations of the logarithms of strength and rhythm; and metres by which a hand that pats
# lands elsewhere.
_STRENGTH, _RHYTHM, _ELSEWHERE = 0.25, 0.12, 4e-3
# Least distance of a touch's centre from the edge, metres; least speed of a hand at a turn, relative to its mean.
_MARGIN, _SLOWEST = 0.02, 0.1
# Least length of a burst in samples, whatever trait is drawn.
_SHORTEST = 0.01


class SoundingPerson(eqx.Module):
    """Traits of one person: `medians`, for each modality its traits by name, in SI units."""

    medians: Mapping[str, Mapping[str, float]] = eqx.field(static=True)

    def __check_init__(self):
        """Raises `ValueError` for modalities and traits other than those of `SOUND_MANNERS`, and what is no size."""
        check_kind("medians", self.medians, Mapping, "traits by modality, such as of SoundingPerson.draw(key)")
        for name, traits in SOUND_MANNERS.items():
            if set(self.medians.get(name, {})) != set(traits):
                raise ValueError(f"medians['{name}'] must have {', '.join(traits) or 'no traits'}.")
            for trait, value in self.medians[name].items():
                check_positive(f"medians['{name}']['{trait}']", value)

    @classmethod
    def draw(cls, key: Array) -> "SoundingPerson":
        """Draw a person: traits log-normal about the population medians, `slope` normal. Raises `ValueError` for no
        key."""
        check_key(key)
        rng = _generator(key)
        own = {}
        for name, traits in SOUND_MANNERS.items():
            own[name] = {}
            for trait, usual in traits.items():
                normal = rng.normal()
                if trait == "slope":
                    own[name][trait] = max(usual.median + usual.spread * normal, 0.1)
                else:
                    own[name][trait] = float(usual.median * np.exp(usual.spread * normal))
        return cls(own)

    def touch(self, key: Array, modality: str, skin: SoundingSkin, *, duration: float = 2.9) -> SimulatedSound:
        """Simulate `duration` seconds of one modality at a random position of the skin, without noise.

        Traits are log-normal about the person's own with a deviation of 0.25. Raises `ValueError` for what is no key,
        skin, modality or duration.
        """
        check_skin_and_key(skin, key)
        check_name("modality", modality, MODALITIES)
        check_positive("duration", duration)
        drawn, rest = jax.random.split(key)
        rng = _generator(drawn)
        if modality == "none":
            return _silent(skin, duration)
        traits = {}
        for name, own in self.medians[modality].items():
            if name == "slope":
                traits[name] = max(own + SLOPE_AMONG / 2 * rng.normal(), 0.1)
            else:
                traits[name] = float(own * np.exp(WITHIN * rng.normal()))
        # The touch has its own spectral slope; the microphones' noise, which depends on the skin's, is not added here.
        toned = eqx.tree_at(lambda one: one.spectral_slope, skin, traits.pop("slope"))
        return _MAKES[modality](rng, toned, rest, traits, duration)


def _taps(rng: np.random.Generator, skin: SoundingSkin, key: Array, traits: dict, duration: float) -> SimulatedSound:
    """Simulate pats and tickles: taps of random strength and rhythm, at positions within `radius`."""
    burst = Burst(traits["strength"], max(traits["length"], _SHORTEST))
    interval, radius = traits["interval"], traits.get("radius", _ELSEWHERE)
    count = int(np.ceil(2 * duration / interval)) + 2
    gaps = interval * np.exp(_RHYTHM * rng.normal(size=count))
    # The recording begins at any moment of the rhythm.
    onsets = ONSET - rng.uniform(0, interval) + np.cumsum(gaps) - gaps[0]
    onsets = onsets[(onsets > -burst.length) & (onsets < duration)]
    strengths = burst.strength * np.exp(_STRENGTH * rng.normal(size=len(onsets)))
    times = sample_times(skin, duration)
    spread = radius * np.sqrt(rng.uniform(size=len(onsets)))
    angle = rng.uniform(0, 2 * np.pi, len(onsets))
    landed = _within(skin, _somewhere(rng, skin) + np.stack([spread * np.cos(angle), spread * np.sin(angle)], axis=-1))
    blocks = np.maximum(np.searchsorted(onsets, block_times(skin, len(times)) + HOP, side="right") - 1, 0)
    return record(skin, key, landed[blocks], burst.envelope(times, onsets, strengths), False)


def _stroke(rng: np.random.Generator, skin: SoundingSkin, key: Array, traits: dict, duration: float) -> SimulatedSound:
    """Simulate a stroke to and fro along a straight path, slower at the turns."""
    angle, phase = rng.uniform(0, 2 * np.pi, 2)
    half = traits["path"] / 2 * np.array([np.cos(angle), np.sin(angle)])
    room = np.array([skin.layer.width, skin.layer.height]) / 2 - _MARGIN
    half = half * min(1.0, float(np.min(room / np.maximum(np.abs(half), 1e-9))))
    length = 2 * float(np.linalg.norm(half))
    middle = np.clip(_somewhere(rng, skin), -(room - np.abs(half)), room - np.abs(half))
    times = sample_times(skin, duration)
    # The mean speed of a sine of amplitude L/2 and angular frequency w is L w / π.
    turning = np.pi * traits["speed"] / length
    speed = np.maximum(length / 2 * turning * np.abs(np.cos(turning * times + phase)), _SLOWEST * traits["speed"])
    centres = block_times(skin, len(times))
    places = _within(skin, middle + np.sin(turning * centres + phase)[:, None] * half)
    return record(skin, key, places, traits["strength"] * np.sqrt(speed / NOMINAL_SPEED), False)


def _wind(rng: np.random.Generator, skin: SoundingSkin, key: Array, traits: dict, duration: float) -> SimulatedSound:
    """Simulate an air jet held over one position."""
    return wind(skin, key, _somewhere(rng, skin), slope=skin.spectral_slope, duration=duration, noise=False, **traits)


_MAKES: dict[str, Callable[..., SimulatedSound]] = {"pat": _taps, "tickle": _taps, "stroke": _stroke, "wind": _wind}


def _silent(skin: SoundingSkin, duration: float) -> SimulatedSound:
    """Simulate silence, with nobody there."""
    silence = quiet(skin, jax.random.key(0), duration=duration)
    return SimulatedSound(
        np.zeros_like(silence.samples), skin.rate, np.zeros((0, 2)), np.zeros(0), silence.active, False
    )


def _somewhere(rng: np.random.Generator, skin: SoundingSkin) -> np.ndarray:
    half = np.array([skin.layer.width, skin.layer.height]) / 2
    return rng.uniform(-1, 1, 2) * np.maximum(half - _MARGIN, half / 2)


def _within(skin: SoundingSkin, places: np.ndarray) -> np.ndarray:
    half = np.array([skin.layer.width, skin.layer.height]) / 2
    return np.clip(places, -half, half)


def _generator(key: Array) -> np.random.Generator:
    return np.random.default_rng(np.asarray(jax.random.bits(key, (4,))).tolist())
