"""Simulation of the sound of touches on an acoustic skin: taps, pats, tickles and strokes. Results include the true
source.

All functions take an explicit random key, and the same key gives the same samples.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from jeit.acoustic.simulate.sound import HOP, SimulatedSound, block_times, simulate_recording
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import (
    FIRM_BURST,
    FIRST_ONSET,
    LIGHT_BURST,
    VIBRATOR_BURST,
    Burst,
    check_burst,
    sample_times,
)
from jeit.arguments.checks import check_positive

# Speed in m/s at which a stroke has its nominal strength. The power dissipated by friction is force times speed, so the
# power of the sound is taken as proportional to speed, and the amplitude to the square root of speed.
NOMINAL_SPEED = 0.1


def simulate_tap(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    burst: Burst = VIBRATOR_BURST,
    repeats: int = 1,
    frequency: float = 10.0,
    duration: float = 0.15,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a recording of taps at one position, as by a vibrator with a rubber tip.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `position`: position (2,), metres.
    - `burst`: envelope of a tap.
    - `repeats`: number of taps.
    - `frequency`: taps per second.
    - `duration`: duration of the recording, seconds, extended if the taps take longer.
    - `noise`: whether to add the microphones' noise.

    Raises `ValueError` for a position outside the skin, for values that are not positive, and if `duration` is too
    short for one tap.

    **Example:**

    ```python
    touch = simulate_tap(skin, key, (0.03, 0.02), repeats=2)
    recording = Recording(touch.samples, touch.rate)
    ```
    """
    check_skin_and_key(skin, key)
    check_positive("frequency", frequency)
    if repeats < 1:
        raise ValueError(f"repeats: give at least one tap, not {repeats}.")
    check_burst(burst, duration)
    onsets = FIRST_ONSET + np.arange(repeats) / frequency
    times = sample_times(skin, max(duration, onsets[-1] + burst.length + 0.03))
    envelope = burst.envelope(times, onsets, np.full(repeats, burst.strength))
    return simulate_recording(skin, key, _check_position(skin, position), envelope, noise)


def simulate_pat(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    burst: Burst = FIRM_BURST,
    taps: int = 3,
    interval: float = 0.3,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a recording of a pat: firm taps of a hand at one position, at regular intervals.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `position`: position (2,), metres.
    - `burst`: envelope of a tap.
    - `taps`: number of taps.
    - `interval`: time between taps, seconds.
    - `duration`: duration of the recording, seconds, extended if the taps take longer.
    - `noise`: whether to add the microphones' noise.

    Raises `ValueError` as `simulate_tap` does.

    **Example:**

    ```python
    touch = simulate_pat(skin, key, (0.03, 0.02), taps=4)
    recording = Recording(touch.samples, touch.rate)
    ```
    """
    check_positive("interval", interval)
    repetition = {"repeats": taps, "frequency": 1 / interval}
    return simulate_tap(skin, key, position, burst=burst, **repetition, duration=duration, noise=noise)


def simulate_tickle(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    burst: Burst = LIGHT_BURST,
    radius: float = 0.01,
    taps_per_second: float = 15.0,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a recording of a tickle: many light taps of random strength and rhythm near a position.

    Each tap is half way between the previous tap and a random position near `position`; taps outside the skin are moved
    to the edge of the skin. The strengths are log-normal, with the standard deviation 0.3 of the logarithm. Each tap is
    delayed by a random time of up to a quarter of the interval between taps.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `position`: mean position (2,) of the taps, metres.
    - `burst`: envelope of a tap; the strength of `burst` is the median of the strengths.
    - `radius`: largest distance of the random positions from `position`, metres.
    - `taps_per_second`: mean number of taps per second.
    - `duration`: duration of the recording, seconds.
    - `noise`: whether to add the microphones' noise.

    Raises `ValueError` as `simulate_tap` does.

    **Example:**

    ```python
    touch = simulate_tickle(skin, key, (0.03, 0.02), radius=0.015)
    recording = Recording(touch.samples, touch.rate)
    ```
    """
    check_skin_and_key(skin, key)
    centre = _check_position(skin, position)[0]
    check_positive("radius", radius)
    check_positive("taps_per_second", taps_per_second)
    check_burst(burst, duration)
    times = sample_times(skin, duration)
    num_taps = max(1, int((duration - FIRST_ONSET - burst.length) * taps_per_second))
    position_key, jitter_key, strength_key, sound_key = jax.random.split(key, 4)
    onsets = (
        FIRST_ONSET
        + (np.arange(num_taps) + 0.25 * np.asarray(jax.random.uniform(jitter_key, (num_taps,)))) / taps_per_second
    )
    strengths = burst.strength * np.exp(0.3 * np.asarray(jax.random.normal(strength_key, (num_taps,))))
    distance, angle = np.asarray(jax.random.uniform(position_key, (2, num_taps)))
    # The square root of a uniform number makes the positions uniform over the disc.
    offsets = (radius * np.sqrt(distance) * [np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)]).T
    for index in range(1, num_taps):
        offsets[index] = (offsets[index - 1] + offsets[index]) / 2
    half_size = np.array([skin.layer.width, skin.layer.height]) / 2
    tap_positions = np.clip(centre + offsets, -half_size, half_size)
    # The source moves to the position of a tap at the onset of that tap.
    blocks = np.maximum(np.searchsorted(onsets, block_times(skin, len(times)) + HOP, side="right") - 1, 0)
    return simulate_recording(skin, sound_key, tap_positions[blocks], burst.envelope(times, onsets, strengths), noise)


def simulate_stroke(
    skin: SoundingSkin,
    key: Array,
    path: ArrayLike,
    *,
    strength: float = 1.0,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a recording of a stroke: a finger that rubs along a path.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `path`: vertices (K, 2) of a polyline, metres, traversed at constant speed; or a function that returns positions
      (N, 2) in metres at times (N,) in seconds.
    - `strength`: root mean square of the sound at 0.1 m/s, which is proportional to the square root of speed.
    - `duration`: duration of the stroke, seconds.
    - `noise`: whether to add the microphones' noise.

    Raises `ValueError` for paths that leave the skin or have no length.

    **Example:**

    ```python
    touch = simulate_stroke(skin, key, [(-0.05, 0.0), (0.05, 0.02)], duration=0.5)
    recording = Recording(touch.samples, touch.rate)
    ```
    """
    check_skin_and_key(skin, key)
    check_positive("strength", strength)
    check_positive("duration", duration)
    times = sample_times(skin, duration)
    position_at = path if callable(path) else _position_on_polyline(skin, path, duration)
    path_positions = skin.layer.check_inside("path", position_at(times))
    if len(path_positions) != len(times):
        raise ValueError(
            f"path: the function gave {len(path_positions)} positions for {len(times)} times; give one for each."
        )
    speed = np.linalg.norm(np.gradient(path_positions, times, axis=0), axis=1)
    if not speed.any():
        raise ValueError(
            "path: its length is zero, and a finger at rest makes no sound; give a longer path, or simulate a tap."
        )
    # The stroke fades in and out over 20 ms.
    fade = np.sin(np.pi / 2 * np.clip(np.minimum(times, duration - times) / 0.02, 0, 1))
    block_centres = block_times(skin, len(times))
    positions = np.stack([np.interp(block_centres, times, axis) for axis in path_positions.T], axis=-1)
    return simulate_recording(skin, key, positions, strength * np.sqrt(speed / NOMINAL_SPEED) * fade, noise)


def _position_on_polyline(skin: SoundingSkin, corners, duration: float) -> Callable[[np.ndarray], np.ndarray]:
    vertices = skin.layer.check_inside("path", corners)
    arc_lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(vertices, axis=0), axis=1))])
    return lambda times: np.stack(
        [np.interp(times / duration * arc_lengths[-1], arc_lengths, axis) for axis in vertices.T], axis=-1
    )


def _check_position(skin: SoundingSkin, position) -> np.ndarray:
    return skin.layer.check_inside("position", [position])
