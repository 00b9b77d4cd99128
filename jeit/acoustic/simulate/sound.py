"""Simulation of recordings: synthesis of noise and of bursts of noise, and the samples of all channels for a sound
source, with the source's true position and amplitude.

The sound of a touch on soft rubber is modelled as band-limited random noise, steady or in bursts: white noise is
multiplied by an envelope and then filtered. All functions take an explicit random key, and the same key gives the same
samples.

The mean over random keys of the energy received from a touch with envelope e(t) at a fixed position is Σ e² times
`expected_power`, except for sound beyond the ends of the recording.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import next_fast_len

from jeit.acoustic.simulate.propagation import band_filter, noise_power, source_density, transfer
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.arguments import check_kind
from jeit.arguments.checks import check_positive
from jeit_solvers.module import Module

# Duration in seconds for which the zero-phase filter of the source rings before and after a burst: about the inverse of
# the filter's lowest frequency.
FILTER_RINGING_DURATION = 0.05
# Time in seconds at which the first burst of a recording begins, which leaves room for the ringing of the filter.
FIRST_BURST_TIME = 0.02
# Time in seconds between the positions of a moving source. The source is at rest during each Hann-weighted block of two
# hops; blocks overlap by half, and their weights sum to one. In 10 ms, a fast stroke of 0.5 m/s moves by 5 mm, much
# less than the distance over which the received power changes.
SOURCE_POSITION_INTERVAL = 0.01


def bin_frequencies(skin: SoundingSkin, num_samples: int, num_bins: int) -> Array:
    """Frequencies (bins,) in Hz of the lowest `num_bins` bins of a Fourier transform of `num_samples` samples."""
    return jnp.arange(num_bins) * (skin.rate / num_samples)


def num_bins_of_source(skin: SoundingSkin, num_samples: int, *, blur: float = 0.0) -> int:
    """Number of bins of a real Fourier transform of `num_samples` samples up to half an octave above the band plus
    `blur` in Hz. The sound has zero amplitude in the remaining bins."""
    return min(int((np.sqrt(2) * skin.readout.band[1] + blur) * num_samples / skin.rate) + 1, num_samples // 2)


def transform_size(count: int, padding: float, rate: float) -> int:
    """Length in samples of a fast Fourier transform of `count` samples with at least `padding` seconds of zeros."""
    min_transform_length = count + int(np.ceil(padding * rate))
    return 2 * int(np.asarray(next_fast_len((min_transform_length + 1) // 2)))


def source_spectrum(skin: SoundingSkin, key: Array, envelope: Array, num_samples: int, num_bins: int) -> Array:
    """Fourier transform (bins,) of the sound of a source: white noise multiplied by `envelope`, and filtered to the
    spectral density of a source.

    Real white noise of variance 1 has the density 2 / rate at positive frequencies.
    """
    white_noise_spectrum = jnp.fft.rfft(jax.random.normal(key, envelope.shape) * envelope, num_samples)[:num_bins]
    return white_noise_spectrum * jnp.sqrt(
        source_density(skin, bin_frequencies(skin, num_samples, num_bins)) * skin.rate / 2
    )


def noise_spectrum(skin: SoundingSkin, key: Array, level: Array, num_samples: int, num_bins: int) -> Array:
    """Fourier transform (M, bins) of the noise of M microphones with mean square `level` (M,) and a flat spectrum in
    the band.

    In a real signal of `num_samples` samples, bin k > 0 with variance v_k contributes 2 v_k / size² to the mean square,
    where size is `num_samples`.
    """
    band_shape = band_filter(skin, bin_frequencies(skin, num_samples, num_bins))
    bin_variance = level[:, None] * band_shape / jnp.sum(band_shape) * num_samples**2 / 2
    normal_draws = jax.random.normal(key, (2, *bin_variance.shape))
    return jnp.sqrt(bin_variance / 2) * (normal_draws[0] + 1j * normal_draws[1])


@partial(jax.jit, static_argnums=(3, 4, 5))
def _noise_samples(skin, key, noise_level, num_samples, transform_length, num_bins):
    return jnp.fft.irfft(noise_spectrum(skin, key, noise_level, transform_length, num_bins), transform_length)[
        :, :num_samples
    ]


def microphone_noise(skin: SoundingSkin, key: Array, count: int) -> Float[np.ndarray, "M S"]:
    """Simulate `count` samples of noise of each microphone, (M, S) with S = `count`."""
    # Noise synthesised from a spectrum is periodic with period `transform_length`. More samples than needed are
    # generated, so that the last samples are independent of the first.
    transform_length = transform_size(count, FILTER_RINGING_DURATION, skin.rate)
    return np.asarray(
        _noise_samples(
            skin, key, noise_power(skin), count, transform_length, num_bins_of_source(skin, transform_length)
        )
    )


def sample_times(skin: SoundingSkin, duration: float) -> Float[np.ndarray, " S"]:
    """Sampling times (S,) of the first channel in seconds, for a recording of `duration` seconds."""
    return np.arange(max(2, round(duration * skin.rate))) / skin.rate


class Burst(Module):
    """Envelope of the sound of a tap, which rises fast and then decays.

    **Fields**: `strength`: root mean square of the sound over `length`; `length`: duration in seconds. Raises
    `ValueError` for values that are not positive.

    **Example:**

    ```python
    light = Burst(strength=0.5, length=0.04)
    touch = simulate_tap(skin, key, (0.02, 0.01), burst=light)
    ```
    """

    strength: float = 1.0
    length: float = 0.06

    def __check_init__(self):
        check_positive("strength", self.strength)
        check_positive("length", self.length)

    def check_fits(self, duration: float) -> None:
        """Raises `ValueError` if a recording of `duration` seconds is too short for one burst."""
        check_positive("duration", duration)
        if duration < FIRST_BURST_TIME + self.length:
            raise ValueError(
                f"duration: a burst of {self.length:g} s that begins at {FIRST_BURST_TIME:g} s does not fit in "
                f"{duration:g} s. Give at least {FIRST_BURST_TIME + self.length:g} s, or a shorter length."
            )

    def envelope(
        self, times: Float[np.ndarray, " S"], onsets: Float[np.ndarray, " N"], strengths: Float[np.ndarray, " N"]
    ) -> Float[np.ndarray, " S"]:
        """Root mean square (S,) of the sound at `times` in seconds of N bursts of this length, with the given `onsets`
        (N,) in seconds and `strengths` (N,).

        The shape of a burst is t e^(-t / a) with a = length / 6. The shape reaches its maximum after a sixth of
        `length`, and is 4 % of the maximum at the end. The integral of its square is a³ / 4; divided by `length`, this
        integral is the mean square by which the shape is normalised.
        """
        rise_time = self.length / 6
        elapsed_times = np.maximum(times - onsets[:, None], 0)
        burst_shape = elapsed_times * np.exp(-elapsed_times / rise_time) / np.sqrt(rise_time**3 / 4 / self.length)
        # Overlapping bursts are treated as independent noises, so the powers of the bursts add.
        return np.sqrt(((strengths[:, None] * burst_shape) ** 2).sum(axis=0))


def check_burst(burst: Burst, duration: float) -> None:
    """Raises `ValueError` if `burst` is not a `Burst`, or if a recording of `duration` seconds is too short for one
    burst."""
    check_kind("burst", burst, Burst, "a Burst, such as Burst(strength=2.0)")
    burst.check_fits(duration)


# Bursts of a vibrator with a rubber tip, of the palm of a hand, and of tickling fingers.
VIBRATOR_BURST, FIRM_BURST, LIGHT_BURST = Burst(), Burst(2.0, 0.08), Burst(0.7, 0.04)


class SimulatedSound(Module):
    """Simulated samples of M channels during a touch, and the true source.

    **Fields**: `samples`: (M, S), in the unit of source strength; `rate`: sampling rate in Hz; `position`: positions
    (N, 2) of the source in metres at `position_times` (N,) in seconds (a silent source has the position of its last or
    first sound, and N = 0 without a source); `active`: root mean square (S,) of the source's sound at `times`, without
    the delay of propagation; `noisy`: whether the samples include noise.
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
    recording_shapes = {(recording.samples.shape, recording.rate) for recording in recordings}
    if (
        len(recording_shapes) > 1
        or recordings[0].samples.shape[0] != skin.num_microphones
        or recordings[0].rate != skin.rate
    ):
        raise ValueError(
            f"recordings: all must come from this skin and last equally long; shapes and rates are {recording_shapes}."
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
    transform_length = transform_size(num_samples, FILTER_RINGING_DURATION, skin.rate)
    block_length = transform_size(2 * round(SOURCE_POSITION_INTERVAL * skin.rate), skin.layer.longest_delay, skin.rate)
    samples = np.asarray(
        _moving_source_samples(
            skin,
            source_key,
            positions,
            envelope,
            transform_length,
            block_length,
            num_bins_of_source(skin, block_length, blur=4 / SOURCE_POSITION_INTERVAL),
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
    return SOURCE_POSITION_INTERVAL * np.arange(int(np.ceil(count / round(SOURCE_POSITION_INTERVAL * skin.rate))) + 1)


@partial(jax.jit, static_argnums=(4, 5, 6))
def _moving_source_samples(skin, key, positions, envelope, num_samples, block_length, num_bins):
    num_recorded, hop_length = envelope.shape[0], round(SOURCE_POSITION_INTERVAL * skin.rate)
    source_samples = jnp.fft.irfft(
        source_spectrum(skin, key, envelope, num_samples, num_samples // 2 + 1), num_samples
    )[:num_recorded]
    source_samples = jnp.pad(source_samples, (hop_length, positions.shape[0] * hop_length + hop_length - num_recorded))
    block_window = jnp.sin(jnp.pi * jnp.arange(2 * hop_length) / (2 * hop_length)) ** 2
    frequencies = bin_frequencies(skin, block_length, num_bins)

    def add_block(channel_samples, block_item):
        block_index, block_position = block_item
        block_sound = (
            jax.lax.dynamic_slice(source_samples, (block_index * hop_length,), (2 * hop_length,)) * block_window
        )
        block_spectrum = jnp.fft.rfft(block_sound, block_length)[:num_bins] * transfer(
            skin, frequencies, block_position
        )
        output_block = jax.lax.dynamic_slice(
            channel_samples, (0, block_index * hop_length), (channel_samples.shape[0], block_length)
        )
        return jax.lax.dynamic_update_slice(
            channel_samples, output_block + jnp.fft.irfft(block_spectrum, block_length), (0, block_index * hop_length)
        ), None

    channel_samples = jnp.zeros((skin.num_microphones, positions.shape[0] * hop_length + block_length))
    channel_samples, _ = jax.lax.scan(add_block, channel_samples, (jnp.arange(positions.shape[0]), positions))
    return channel_samples[:, hop_length : hop_length + num_recorded]
