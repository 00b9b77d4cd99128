"""Simulation of the sound of touches on an acoustic skin: taps, pats, tickles and strokes, and the taps at known
positions for a calibration. Results include the true source.

All functions take an explicit random key, and the same key gives the same samples.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.acoustic.simulate.propagation import noise_power, transfer
from jeit.acoustic.simulate.sound import (
    FILTER_RINGING_DURATION,
    FIRM_BURST,
    FIRST_BURST_TIME,
    LIGHT_BURST,
    SOURCE_POSITION_INTERVAL,
    VIBRATOR_BURST,
    Burst,
    SimulatedSound,
    bin_frequencies,
    block_times,
    check_burst,
    noise_spectrum,
    num_bins_of_source,
    sample_times,
    simulate_recording,
    source_spectrum,
    transform_size,
)
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.arguments.checks import check_not_negative, check_positive
from jeit_solvers.module import Module

# Speed in m/s at which a stroke has its nominal strength. The power dissipated by friction is force times speed, so the
# power of the sound is taken as proportional to speed, and the amplitude to the square root of speed.
NOMINAL_SPEED = 0.1
# Maximum number of samples computed at once: 32 MB.
MAX_CHUNK_SAMPLES = 2**22


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
    tap_onsets = FIRST_BURST_TIME + np.arange(repeats) / frequency
    times = sample_times(skin, max(duration, tap_onsets[-1] + burst.length + 0.03))
    envelope = burst.envelope(times, tap_onsets, np.full(repeats, burst.strength))
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
    repetition_options = {"repeats": taps, "frequency": 1 / interval}
    return simulate_tap(skin, key, position, burst=burst, **repetition_options, duration=duration, noise=noise)


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
    disc_centre = _check_position(skin, position)[0]
    check_positive("radius", radius)
    check_positive("taps_per_second", taps_per_second)
    check_burst(burst, duration)
    times = sample_times(skin, duration)
    num_taps = max(1, int((duration - FIRST_BURST_TIME - burst.length) * taps_per_second))
    position_key, jitter_key, strength_key, sound_key = jax.random.split(key, 4)
    tap_onsets = (
        FIRST_BURST_TIME
        + (np.arange(num_taps) + 0.25 * np.asarray(jax.random.uniform(jitter_key, (num_taps,)))) / taps_per_second
    )
    strengths = burst.strength * np.exp(0.3 * np.asarray(jax.random.normal(strength_key, (num_taps,))))
    relative_distances, relative_angles = np.asarray(jax.random.uniform(position_key, (2, num_taps)))
    # The square root of a uniform number makes the positions uniform over the disc.
    tap_offsets = (
        radius
        * np.sqrt(relative_distances)
        * [np.cos(2 * np.pi * relative_angles), np.sin(2 * np.pi * relative_angles)]
    ).T
    for tap_index in range(1, num_taps):
        tap_offsets[tap_index] = (tap_offsets[tap_index - 1] + tap_offsets[tap_index]) / 2
    half_skin_size = np.array([skin.layer.width, skin.layer.height]) / 2
    tap_positions = np.clip(disc_centre + tap_offsets, -half_skin_size, half_skin_size)
    # The source moves to the position of a tap at the onset of that tap.
    tap_of_block = np.maximum(
        np.searchsorted(tap_onsets, block_times(skin, len(times)) + SOURCE_POSITION_INTERVAL, side="right") - 1, 0
    )
    return simulate_recording(
        skin, sound_key, tap_positions[tap_of_block], burst.envelope(times, tap_onsets, strengths), noise
    )


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
    - `strength`: root mean square of the sound at a speed of 0.1 m/s; the sound is proportional to the square root of
      speed.
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
    finger_speed = np.linalg.norm(np.gradient(path_positions, times, axis=0), axis=1)
    if not finger_speed.any():
        raise ValueError(
            "path: its length is zero, and a finger at rest makes no sound; give a longer path, or simulate a tap."
        )
    # The stroke fades in and out over 20 ms.
    fade_amplitude = np.sin(np.pi / 2 * np.clip(np.minimum(times, duration - times) / 0.02, 0, 1))
    block_centres = block_times(skin, len(times))
    block_positions = np.stack(
        [np.interp(block_centres, times, axis_positions) for axis_positions in path_positions.T], axis=-1
    )
    return simulate_recording(
        skin, key, block_positions, strength * np.sqrt(finger_speed / NOMINAL_SPEED) * fade_amplitude, noise
    )


def _position_on_polyline(skin: SoundingSkin, path_corners, duration: float) -> Callable[[np.ndarray], np.ndarray]:
    path_vertices = skin.layer.check_inside("path", path_corners)
    arc_lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path_vertices, axis=0), axis=1))])
    return lambda times: np.stack(
        [
            np.interp(times / duration * arc_lengths[-1], arc_lengths, axis_positions)
            for axis_positions in path_vertices.T
        ],
        axis=-1,
    )


def _check_position(skin: SoundingSkin, position) -> np.ndarray:
    return skin.layer.check_inside("position", [position])


class CalibrationTaps(Module):
    """Simulated recordings of T taps at known positions, for calibration.

    **Fields**: `samples`: recorded samples (T, M, S); `rate`: sampling rate in Hz; `positions`: positions of the taps
    (T, 2) in metres; `strengths`: true strengths of the taps (T,).
    """

    samples: Float[np.ndarray, "T M S"]
    rate: float
    positions: Float[np.ndarray, "T 2"]
    strengths: Float[np.ndarray, " T"]


def simulate_calibration_taps(
    skin: SoundingSkin,
    key: Array,
    positions: ArrayLike,
    *,
    repeats: int = 3,
    burst: Burst = VIBRATOR_BURST,
    strength_spread: float = 0.3,
    duration: float = 0.15,
    noise: bool = True,
    progress: Callable[[str], None] | None = None,
) -> CalibrationTaps:
    """Simulate repeated calibration taps at each of P positions: T = P · repeats recordings, ordered by position.

    The strengths of the taps are log-normal, and unknown to a calibration.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `positions`: tapped positions (P, 2), metres.
    - `repeats`: number of taps at each position.
    - `burst`: envelope of a tap; the strength of `burst` is the median of the strengths.
    - `strength_spread`: standard deviation of the logarithm of the taps' strengths.
    - `duration`: duration of each recording, seconds.
    - `noise`: whether to add the microphones' noise.
    - `progress`: function called with a text after each part of the computation.

    Raises `ValueError` as `simulate_tap` does.

    **Example:**

    ```python
    tapped = simulate_calibration_taps(skin, key, grid(0.1, 0.1, 2, 2), repeats=1)
    print(tapped.samples.shape)  # (4, 16, …)
    ```
    """
    check_skin_and_key(skin, key)
    tap_positions = skin.layer.check_inside("positions", positions)
    if repeats < 1:
        raise ValueError(f"repeats: give at least one tap for each position, not {repeats}.")
    check_not_negative("strength_spread", strength_spread)
    check_burst(burst, duration)
    times = sample_times(skin, duration)
    strength_key, tap_key = jax.random.split(key)
    strengths = burst.strength * np.exp(
        strength_spread * np.asarray(jax.random.normal(strength_key, (len(tap_positions), repeats)))
    )
    envelope = burst.envelope(times, np.array([FIRST_BURST_TIME]), np.array([1.0]))
    transform_length = transform_size(len(times), skin.layer.longest_delay + FILTER_RINGING_DURATION, skin.rate)
    samples = np.empty((len(tap_positions), repeats, skin.num_microphones, len(times)))
    noise_level = noise_power(skin) if noise else None
    random_keys = jax.random.split(tap_key, len(tap_positions))
    # The taps are computed in chunks, which limits memory. All chunks have the same size, so that one compiled program
    # serves all chunks.
    num_chunks = min(len(tap_positions), -(-samples.size // MAX_CHUNK_SAMPLES))
    for chunk_indices in np.array_split(np.arange(-(-len(tap_positions) // num_chunks) * num_chunks), num_chunks):
        chunk_indices = np.minimum(chunk_indices, len(tap_positions) - 1)
        samples[chunk_indices] = _tap_samples(
            skin,
            random_keys[chunk_indices],
            tap_positions[chunk_indices],
            strengths[chunk_indices],
            envelope,
            noise_level,
            transform_length,
            num_bins_of_source(skin, transform_length),
        )
        if progress is not None:
            progress(f"{chunk_indices[-1] + 1} of {len(tap_positions)} places")
    return CalibrationTaps(
        samples.reshape(-1, *samples.shape[2:]), skin.rate, np.repeat(tap_positions, repeats, axis=0), strengths.ravel()
    )


@partial(jax.jit, static_argnums=(6, 7))
def _tap_samples(
    skin, random_keys, tap_positions, strengths_of_positions, envelope, noise_level, transform_length, num_bins
):
    frequencies = bin_frequencies(skin, transform_length, num_bins)

    def samples_at_position(tap_item):
        random_key, tap_position, tap_strengths = tap_item
        source_key, noise_key = jax.random.split(random_key)
        channel_transfer = transfer(skin, frequencies, tap_position)

        def samples_of_tap(random_key, noise_key, tap_strength):
            channel_spectra = (
                tap_strength
                * source_spectrum(skin, random_key, envelope, transform_length, num_bins)
                * channel_transfer
            )
            if noise_level is not None:
                channel_spectra += noise_spectrum(skin, noise_key, noise_level, transform_length, num_bins)
            return jnp.fft.irfft(channel_spectra, transform_length)[:, : len(envelope)]

        num_repetitions = len(tap_strengths)
        return jax.vmap(samples_of_tap)(
            jax.random.split(source_key, num_repetitions), jax.random.split(noise_key, num_repetitions), tap_strengths
        )

    return jax.lax.map(samples_at_position, (random_keys, tap_positions, strengths_of_positions))
