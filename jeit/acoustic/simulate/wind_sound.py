"""Simulation of airborne sound: an air jet that blows on a skin, and the sound of the surrounding room."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.acoustic.simulate.propagation import band_filter, noise_power, transfer
from jeit.acoustic.simulate.sound import (
    FILTER_RINGING_DURATION,
    SimulatedSound,
    bin_frequencies,
    block_times,
    microphone_noise,
    num_bins_of_source,
    sample_times,
    transform_size,
)
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.arguments.checks import check_not_negative, check_positive

# Number of source positions in an air jet, and number of frequencies at which the total power of the sources is
# computed. The power, which is smooth, is interpolated between these frequencies.
_NUM_EDDIES, _NUM_FREQUENCIES = 64, 160
# Exponent of Kolmogorov's law of turbulence: the energy density is proportional to frequency to minus this power.
KOLMOGOROV_EXPONENT = 5 / 3


def simulate_wind(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    strength: float = 1.0,
    radius: float = 0.03,
    gusts: float = 0.15,
    gust_time: float = 0.2,
    slope: float = KOLMOGOROV_EXPONENT,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a recording of a steady jet of air on the skin, such as from an air brush.

    Eddies act as independent sources at 64 random positions. Since eddies are much smaller than the spacing of the
    microphones, the noises of the microphones are independent. The power of each noise is the total power that the
    microphone receives from the 64 positions.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `position`: mean position (2,) of the eddies, metres.
    - `strength`: root mean square of the sound of all sources together.
    - `radius`: standard deviation of the normally distributed positions of the eddies, metres.
    - `gusts`: standard deviation over time of the logarithm of the amplitude.
    - `gust_time`: correlation time of the amplitude, seconds.
    - `slope`: the power spectral density is proportional to frequency to the power −`slope`.
    - `duration`: duration of the recording, seconds.
    - `noise`: whether to add the microphones' noise.

    Raises `ValueError` for a position outside the skin, and for values out of range.

    **Example:**

    ```python
    sound = simulate_wind(skin, key, (0.03, 0.02), strength=2.0)
    recording = Recording(sound.samples, sound.rate)
    ```
    """
    check_skin_and_key(skin, key)
    jet_centre = skin.layer.check_inside("position", [position])[0]
    for argument_name, argument_value in (
        ("strength", strength),
        ("radius", radius),
        ("gust_time", gust_time),
        ("duration", duration),
    ):
        check_positive(argument_name, argument_value)
    for argument_name, argument_value in (("gusts", gusts), ("slope", slope)):
        check_not_negative(argument_name, argument_value)
    position_key, gust_key, wind_key, noise_key = jax.random.split(key, 4)
    half_skin_size = np.array([skin.layer.width, skin.layer.height]) / 2
    eddy_positions = np.clip(
        jet_centre + radius * np.asarray(jax.random.normal(position_key, (_NUM_EDDIES, 2))),
        -half_skin_size,
        half_skin_size,
    )
    times = sample_times(skin, duration)
    gust_amplitude = np.exp(gusts * _slow_noise(gust_key, len(times), gust_time * skin.rate) - gusts**2)
    spectral_density = _spectral_density(
        skin, slope, _received_power(skin, jnp.asarray(eddy_positions), _frequency_grid(skin))
    )
    samples = strength * gust_amplitude * _coloured_noise(skin, wind_key, spectral_density, len(times))
    if noise:
        samples = samples + microphone_noise(skin, noise_key, len(times))
    block_centres = block_times(skin, len(times))
    position_times = block_centres[block_centres <= len(times) / skin.rate]
    return SimulatedSound(
        samples,
        skin.rate,
        np.tile(jet_centre, (len(position_times), 1)),
        position_times,
        strength * gust_amplitude,
        noise,
    )


def simulate_room_sound(
    skin: SoundingSkin, key: Array, *, level_db: float = 0.0, slope: float = 1.0, duration: float = 1.0
) -> SimulatedSound:
    """Simulate a recording of the sound of a room: the same signal for all microphones, multiplied by their gains.

    **Arguments:**

    - `skin`: the simulated skin.
    - `key`: random key.
    - `level_db`: power of the room's sound relative to the noise power of the nominal microphone, decibels.
    - `slope`: the power spectral density is proportional to frequency to the power −`slope`.
    - `duration`: duration of the recording, seconds.

    Raises `ValueError` for a level that is not finite, a negative slope, and a duration that is not positive.

    **Example:**

    ```python
    sound = simulate_room_sound(skin, key, level_db=-6)
    recording = Recording(sound.samples, sound.rate)
    ```
    """
    check_skin_and_key(skin, key)
    check_positive("duration", duration)
    check_not_negative("slope", slope)
    if not np.isfinite(level_db):
        raise ValueError(f"level_db must be finite, in decibels; it is {level_db}.")
    times = sample_times(skin, duration)
    room_power = float(np.median(noise_power(skin) / np.asarray(skin.noise_factor))) * 10 ** (level_db / 10)
    room_signal = _coloured_noise(
        skin, key, room_power * _spectral_density(skin, slope, np.ones((1, _NUM_FREQUENCIES))), len(times)
    )
    samples = np.asarray(skin.gain)[:, None] * room_signal
    return SimulatedSound(samples, skin.rate, np.zeros((0, 2)), np.zeros(0), np.zeros(len(times)), False)


def _frequency_grid(skin: SoundingSkin) -> Float[np.ndarray, " G"]:
    """Frequencies (G,) in Hz with equal ratios, from half an octave below the band to half an octave above the band."""
    lowest_frequency, highest_frequency = skin.readout.band
    return np.geomspace(lowest_frequency / np.sqrt(2), highest_frequency * np.sqrt(2), _NUM_FREQUENCIES)


@jax.jit
def _received_power(skin: SoundingSkin, source_positions: Array, frequencies: Array) -> Array:
    """Power (M, G) received by each microphone at G `frequencies` from equal sources at all `source_positions` (P, 2),
    divided by the total power of the sources."""
    total_power = jnp.zeros((skin.microphones.shape[0], len(frequencies)))

    def add_source(source_index, total_power):
        return total_power + jnp.abs(transfer(skin, frequencies, source_positions[source_index])) ** 2

    return jax.lax.fori_loop(0, len(source_positions), add_source, total_power) / len(source_positions)


def _spectral_density(skin: SoundingSkin, slope: float, received_power: ArrayLike) -> Float[np.ndarray, "M G"]:
    """Power spectral densities (M, G) at the microphones, in 1/Hz, for sources of total mean square 1. `received_power`
    (M, G): received power divided by the power of the sources."""
    frequency_grid = _frequency_grid(skin)
    spectrum_shape = (
        np.asarray(band_filter(skin, jnp.asarray(frequency_grid))) * (frequency_grid / frequency_grid[0]) ** -slope
    )
    return np.asarray(received_power) * spectrum_shape / np.trapezoid(spectrum_shape, frequency_grid)


def _coloured_noise(
    skin: SoundingSkin, key: Array, spectral_density: Float[np.ndarray, "M G"], num_samples: int
) -> np.ndarray:
    """Simulate `num_samples` samples (M, S) of independent noises at M microphones, with the power spectral densities
    `spectral_density`."""
    transform_length = transform_size(num_samples, FILTER_RINGING_DURATION, skin.rate)
    num_bins = num_bins_of_source(skin, transform_length)
    frequencies = np.asarray(bin_frequencies(skin, transform_length, num_bins))
    frequency_grid = _frequency_grid(skin)
    # In a real signal of `transform_length` samples, bin k > 0 with variance v_k contributes 2 v_k / size² to the mean
    # square.
    bin_variances = np.stack(
        [
            np.interp(frequencies, frequency_grid, channel_density, left=0.0, right=0.0)
            for channel_density in spectral_density
        ]
    )
    normal_draws = np.asarray(jax.random.normal(key, (2, len(spectral_density), num_bins)))
    channel_spectra = np.sqrt(bin_variances * skin.rate * transform_length / 4) * (
        normal_draws[0] + 1j * normal_draws[1]
    )
    return np.fft.irfft(channel_spectra, transform_length)[:, :num_samples]


def _slow_noise(key: Array, num_samples: int, correlation_length: float) -> Float[np.ndarray, " S"]:
    """Simulate slowly varying normal noise (S,) of variance 1, with a correlation length of `correlation_length`
    samples."""
    num_knots = int(np.ceil(num_samples / correlation_length)) + 3
    knot_values = np.asarray(jax.random.normal(key, (num_knots,)))
    # The interpolation weights are the cosine and sine of the same angle, so the variance of the noise is 1 everywhere.
    knot_coordinates = np.arange(num_samples) / correlation_length
    knot_index = knot_coordinates.astype(int)
    blend_angle = np.pi / 2 * (knot_coordinates - knot_index)
    return np.cos(blend_angle) * knot_values[knot_index] + np.sin(blend_angle) * knot_values[knot_index + 1]
