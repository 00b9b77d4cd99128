"""Simulation of calibration taps at known positions on a skin."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.acoustic.simulate.propagation import noise_power, transfer
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import (
    FIRST_ONSET,
    RINGING_TIME,
    VIBRATOR_BURST,
    Burst,
    bin_frequencies,
    check_burst,
    noise_spectrum,
    num_filled_bins,
    sample_times,
    source_spectrum,
    transform_size,
)
from jeit.arguments.checks import check_not_negative
from jeit_solvers.module import Module

# Maximum number of samples computed at once: 32 MB.
MAX_CHUNK_SAMPLES = 2**22


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
    envelope = burst.envelope(times, np.array([FIRST_ONSET]), np.array([1.0]))
    size = transform_size(len(times), skin.layer.longest_delay + RINGING_TIME, skin.rate)
    samples = np.empty((len(tap_positions), repeats, skin.num_microphones, len(times)))
    level = noise_power(skin) if noise else None
    keys = jax.random.split(tap_key, len(tap_positions))
    # The taps are computed in chunks, which limits memory. All chunks have the same size, so that one compiled program
    # serves all chunks.
    num_chunks = min(len(tap_positions), -(-samples.size // MAX_CHUNK_SAMPLES))
    for chunk in np.array_split(np.arange(-(-len(tap_positions) // num_chunks) * num_chunks), num_chunks):
        chunk = np.minimum(chunk, len(tap_positions) - 1)
        samples[chunk] = _tap_samples(
            skin,
            keys[chunk],
            tap_positions[chunk],
            strengths[chunk],
            envelope,
            level,
            size,
            num_filled_bins(skin, size),
        )
        if progress is not None:
            progress(f"{chunk[-1] + 1} of {len(tap_positions)} places")
    return CalibrationTaps(
        samples.reshape(-1, *samples.shape[2:]), skin.rate, np.repeat(tap_positions, repeats, axis=0), strengths.ravel()
    )


@partial(jax.jit, static_argnums=(6, 7))
def _tap_samples(skin, keys, positions, strengths, envelope, level, size, bins):
    frequencies = bin_frequencies(skin, size, bins)

    def samples_at_position(item):
        key, position, tap_strengths = item
        source_key, noise_key = jax.random.split(key)
        channels = transfer(skin, frequencies, position)

        def samples_of_tap(key, noise_key, strength):
            spectrum = strength * source_spectrum(skin, key, envelope, size, bins) * channels
            if level is not None:
                spectrum += noise_spectrum(skin, noise_key, level, size, bins)
            return jnp.fft.irfft(spectrum, size)[:, : len(envelope)]

        repeats = len(tap_strengths)
        return jax.vmap(samples_of_tap)(
            jax.random.split(source_key, repeats), jax.random.split(noise_key, repeats), tap_strengths
        )

    return jax.lax.map(samples_at_position, (keys, positions, strengths))
