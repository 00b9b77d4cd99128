"""Simulation of recordings: the samples of all channels for a sound source, with the source's true position and
amplitude.

A touch with envelope e(t) at a fixed position is received with an energy whose mean over random keys is Σ e² times
`expected_power`, except for sound beyond the ends of the recording.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.acoustic.simulate.propagation import transfer
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import (
    RINGING_TIME,
    bin_frequencies,
    microphone_noise,
    num_filled_bins,
    sample_times,
    source_spectrum,
    transform_size,
)
from jeit.arguments.checks import check_positive
from jeit_solvers.module import Module

# Time in seconds between the positions of a moving source. The source is at rest during each Hann-weighted block of two
# hops; blocks overlap by half, and their weights sum to one. In 10 ms, a fast stroke of 0.5 m/s moves by 5 mm, much
# less than the distance over which the received power changes.
HOP = 0.01


class SimulatedSound(Module):
    """Simulated samples of M channels during a touch, and the true source.

    **Fields**: `samples`: (M, S), in the unit of source strength; `rate`: sampling rate in Hz; `position`: positions
    (N, 2) of the source in metres at `position_times` (N,) in seconds, where N = 0 for `simulate_silence`, and a silent
    source has the position of its last or first sound; `active`: root mean square (S,) of the source's sound at
    `times`, without the delay of propagation; `noisy`: whether the samples include noise.
    """

    samples: Float[np.ndarray, "M S"]
    rate: float
    position: Float[np.ndarray, "N 2"]
    position_times: Float[np.ndarray, " N"]
    active: Float[np.ndarray, " S"]
    noisy: bool = eqx.field(static=True)

    @property
    def times(self) -> np.ndarray:
        """Sampling times (S,) of the first channel in seconds. The other channels are delayed by `skin.stagger`."""
        return np.arange(self.samples.shape[1]) / self.rate


def simulate_silence(skin: SoundingSkin, key: Array, *, duration: float = 1.0) -> SimulatedSound:
    """Simulate a recording of the microphones' noise without a sound source.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `duration`: duration of the recording, seconds.

    Raises `ValueError` for an invalid duration.

    **Example:**

    ```python
    sound = simulate_silence(skin, key, duration=2.0)
    silence = Recording(sound.samples, sound.rate)
    ```
    """
    check_skin_and_key(skin, key)
    check_positive("duration", duration)
    times = sample_times(skin, duration)
    samples = microphone_noise(skin, key, len(times))
    return SimulatedSound(samples, skin.rate, np.zeros((0, 2)), np.zeros(0), np.zeros(len(times)), True)


def superpose(skin: SoundingSkin, key: Array | None, *recordings: SimulatedSound) -> Float[np.ndarray, "M S"]:
    """Return the samples (M, S) of several simultaneous touches, with microphones' noise added unless `key` is None.

    Raises `ValueError` if there are no `recordings`, or if the recordings differ in duration, do not match the skin, or
    include noise; simulate the recordings with `noise=False`.
    """
    check_skin_and_key(skin, jax.random.key(0) if key is None else key)
    if not recordings:
        raise ValueError("recordings: give at least one.")
    if any(recording.noisy for recording in recordings):
        raise ValueError("recordings: simulate them with noise=False; `superpose` adds the noise once.")
    shapes = {(recording.samples.shape, recording.rate) for recording in recordings}
    if len(shapes) > 1 or recordings[0].samples.shape[0] != skin.num_microphones or recordings[0].rate != skin.rate:
        raise ValueError(
            f"recordings: all must come from this skin and last equally long; shapes and rates are {shapes}."
        )
    samples = np.sum([recording.samples for recording in recordings], axis=0)
    return samples if key is None else samples + microphone_noise(skin, key, samples.shape[1])


def simulate_recording(
    skin: SoundingSkin, key: Array, positions: np.ndarray, envelope: np.ndarray, noise: bool
) -> SimulatedSound:
    """Simulate the recording of a source whose sound has the root mean square `envelope` (S,). `positions` of the
    source in metres: (B, 2), one for each block of time, or (1, 2) for a source at rest."""
    source_key, noise_key = jax.random.split(key)
    num_samples, block_centres = len(envelope), block_times(skin, len(envelope))
    positions = np.broadcast_to(positions, (len(block_centres), 2))
    transform_length = transform_size(num_samples, RINGING_TIME, skin.rate)
    block_length = transform_size(2 * round(HOP * skin.rate), skin.layer.longest_delay, skin.rate)
    samples = np.asarray(
        _moving_source_samples(
            skin,
            source_key,
            positions,
            envelope,
            transform_length,
            block_length,
            num_filled_bins(skin, block_length, blur=4 / HOP),
        )
    )
    if noise:
        samples = samples + microphone_noise(skin, noise_key, num_samples)
    is_within_recording = block_centres <= num_samples / skin.rate
    return SimulatedSound(
        samples,
        skin.rate,
        np.array(positions[is_within_recording]),
        block_centres[is_within_recording],
        envelope,
        noise,
    )


def block_times(skin: SoundingSkin, count: int) -> np.ndarray:
    """Middles of the blocks of time that cover `count` samples, in seconds: 0, one hop, two hops, …"""
    return HOP * np.arange(int(np.ceil(count / round(HOP * skin.rate))) + 1)


@partial(jax.jit, static_argnums=(4, 5, 6))
def _moving_source_samples(skin, key, positions, envelope, num_samples, block_length, num_bins):
    num_recorded, hop = envelope.shape[0], round(HOP * skin.rate)
    sound = jnp.fft.irfft(source_spectrum(skin, key, envelope, num_samples, num_samples // 2 + 1), num_samples)[
        :num_recorded
    ]
    sound = jnp.pad(sound, (hop, positions.shape[0] * hop + hop - num_recorded))
    window = jnp.sin(jnp.pi * jnp.arange(2 * hop) / (2 * hop)) ** 2
    frequencies = bin_frequencies(skin, block_length, num_bins)

    def add_block(output, item):
        index, position = item
        block_sound = jax.lax.dynamic_slice(sound, (index * hop,), (2 * hop,)) * window
        spectrum = jnp.fft.rfft(block_sound, block_length)[:num_bins] * transfer(skin, frequencies, position)
        output_block = jax.lax.dynamic_slice(output, (0, index * hop), (output.shape[0], block_length))
        return jax.lax.dynamic_update_slice(
            output, output_block + jnp.fft.irfft(spectrum, block_length), (0, index * hop)
        ), None

    output = jnp.zeros((skin.num_microphones, positions.shape[0] * hop + block_length))
    output, _ = jax.lax.scan(add_block, output, (jnp.arange(positions.shape[0]), positions))
    return output[:, hop : hop + num_recorded]
