"""Simulated touches on an acoustic skin: taps, pats, tickles and strokes, with the true source beside the samples.

Every function takes an explicit key: the same key, the same samples.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from jeit.acoustic.simulate.checks import check_positive
from jeit.acoustic.simulate.sound import HOP, SimulatedSound, block_times, record
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import FIRM, LIGHT, ONSET, VIBRATOR, Burst, check_burst, sample_times

# Friction turns force times speed into heat and sound: a stroke's power goes as its speed, its amplitude as the root.
NOMINAL_SPEED = 0.1


def tap(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    burst: Burst = VIBRATOR,
    repeats: int = 1,
    frequency: float = 10.0,
    duration: float = 0.15,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate `repeats` of a `burst` at one `position` (2,), metres, at `frequency`, Hz, as by a vibrator with a
    rubber tip.

    `duration` of the recording in seconds, made longer where the bursts need it. `noise`: whether to add the
    microphones' own. Raises `ValueError` for a position off the skin, and for what is not positive or does not fit.
    """
    check_skin_and_key(skin, key)
    check_positive("frequency", frequency)
    if repeats < 1:
        raise ValueError(f"repeats: give at least one tap, not {repeats}.")
    check_burst(burst, duration)
    onsets = ONSET + np.arange(repeats) / frequency
    times = sample_times(skin, max(duration, onsets[-1] + burst.length + 0.03))
    envelope = burst.envelope(times, onsets, np.full(repeats, burst.strength))
    return record(skin, key, _place(skin, position), envelope, noise)


def pat(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    burst: Burst = FIRM,
    taps: int = 3,
    interval: float = 0.3,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a few firm taps of a hand at one `position` (2,), metres, `interval` seconds apart; see `tap`."""
    check_positive("interval", interval)
    repeated = {"repeats": taps, "frequency": 1 / interval}
    return tap(skin, key, position, burst=burst, **repeated, duration=duration, noise=noise)


def tickle(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    burst: Burst = LIGHT,
    radius: float = 0.01,
    taps_per_second: float = 15.0,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate many light taps that wander around `position` (2,), metres, of random strength and rhythm.

    Each lands within `radius` metres of `position` (at the edge, on the skin), half way between a new place there and
    the place before it. Strengths are log-normal about that of `burst` with standard deviation 0.3 in the logarithm,
    the times random by a quarter of the interval. Raises `ValueError` as `tap` does.
    """
    check_skin_and_key(skin, key)
    middle = _place(skin, position)[0]
    check_positive("radius", radius)
    check_positive("taps_per_second", taps_per_second)
    check_burst(burst, duration)
    times = sample_times(skin, duration)
    count = max(1, int((duration - ONSET - burst.length) * taps_per_second))
    where, jitter, loudness, rest = jax.random.split(key, 4)
    onsets = ONSET + (np.arange(count) + 0.25 * np.asarray(jax.random.uniform(jitter, (count,)))) / taps_per_second
    strengths = burst.strength * np.exp(0.3 * np.asarray(jax.random.normal(loudness, (count,))))
    distance, angle = np.asarray(jax.random.uniform(where, (2, count)))
    # The root spreads places evenly over the disc.
    offsets = (radius * np.sqrt(distance) * [np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)]).T
    for index in range(1, count):
        offsets[index] = (offsets[index - 1] + offsets[index]) / 2
    half = np.array([skin.layer.width, skin.layer.height]) / 2
    places = np.clip(middle + offsets, -half, half)
    # From its onset on, the source is where that tap is.
    blocks = np.maximum(np.searchsorted(onsets, block_times(skin, len(times)) + HOP, side="right") - 1, 0)
    return record(skin, rest, places[blocks], burst.envelope(times, onsets, strengths), noise)


def stroke(
    skin: SoundingSkin,
    key: Array,
    path: ArrayLike,
    *,
    strength: float = 1.0,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a finger that rubs along `path` for `duration` seconds.

    `path`: corners (K, 2) of a line, metres, run along at even speed, or a function of times (N,) in seconds that gives
    positions (N, 2). `strength`: root mean square at 0.1 m/s; it goes as the square root of the speed. Raises
    `ValueError` for paths that leave the skin, or stand still.
    """
    check_skin_and_key(skin, key)
    check_positive("strength", strength)
    check_positive("duration", duration)
    times = sample_times(skin, duration)
    follow = path if callable(path) else _polyline(skin, path, duration)
    track = skin.layer.check_inside("path", follow(times))
    if len(track) != len(times):
        raise ValueError(f"path: the function gave {len(track)} positions for {len(times)} times; give one for each.")
    speed = np.linalg.norm(np.gradient(track, times, axis=0), axis=1)
    if not speed.any():
        raise ValueError("path: the finger stands still, which makes no sound. Give a path with some length, or a tap.")
    # Fingers do not begin or end in a microsecond.
    ends = np.sin(np.pi / 2 * np.clip(np.minimum(times, duration - times) / 0.02, 0, 1))
    centres = block_times(skin, len(times))
    places = np.stack([np.interp(centres, times, axis) for axis in track.T], axis=-1)
    return record(skin, key, places, strength * np.sqrt(speed / NOMINAL_SPEED) * ends, noise)


def _polyline(skin: SoundingSkin, corners, duration: float) -> Callable[[np.ndarray], np.ndarray]:
    place = skin.layer.check_inside("path", corners)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    return lambda times: np.stack([np.interp(times / duration * along[-1], along, axis) for axis in place.T], axis=-1)


def _place(skin: SoundingSkin, position) -> np.ndarray:
    return skin.layer.check_inside("position", [position])
