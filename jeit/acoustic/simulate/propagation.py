"""Propagation of sound from a touch to the microphones: spreading, loss, dispersion, edge echoes, and the multiplexer.

Sound is propagated in the frequency domain. Expected powers are integrals over frequency, and need no random numbers.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jeit.acoustic.simulate.sounding_skin import MULTIPLEXER_INTERVAL, NUM_MULTIPLEXER_CHANNELS, SoundingSkin


def band_filter(skin: SoundingSkin, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
    """Power response (F,) of the analogue filters at `frequencies` (F,) in Hz: 1 in the band, 1/2 at the limits of the
    band, and 0 more than half an octave outside."""
    log2_frequencies = jnp.log2(jnp.maximum(frequencies, 1e-9))
    log2_lowest, log2_highest = jnp.log2(skin.readout.band[0]), jnp.log2(skin.readout.band[1])
    rising_edge, falling_edge = (
        jnp.clip(log2_frequencies - log2_lowest + 0.5, 0, 1),
        jnp.clip(log2_highest - log2_frequencies + 0.5, 0, 1),
    )
    return (jnp.sin(jnp.pi / 2 * rising_edge) * jnp.sin(jnp.pi / 2 * falling_edge)) ** 2


def source_density(skin: SoundingSkin, frequencies: Float[Array, " F"]) -> Float[Array, " F"]:
    """Power spectral density (F,) of a source of strength 1 at `frequencies` (F,) in Hz, in 1/Hz. The integral of the
    density over positive frequencies is 1."""

    lowest_frequency, highest_frequency = skin.readout.band

    def unnormalised_density(f):
        return band_filter(skin, f) * (jnp.maximum(f, 1e-9) / lowest_frequency) ** -skin.spectral_slope

    # The integral uses a uniform grid of log-frequency, in which both edges of the band filter have the same width: ∫ S
    # df = ∫ S f d(ln f).
    frequency_grid = lowest_frequency * jnp.exp(
        jnp.linspace(-0.35, jnp.log(highest_frequency / lowest_frequency) + 0.35, 2001)
    )
    return unnormalised_density(frequencies) / jnp.trapezoid(
        unnormalised_density(frequency_grid) * frequency_grid, jnp.log(frequency_grid)
    )


@jax.jit
def transfer(skin: SoundingSkin, frequencies: Float[Array, " F"], position: Float[Array, "2"]) -> Complex[Array, "M F"]:
    """Transfer functions (M, F) of the sound amplitude from a source at `position` (2,) in metres to each of M
    channels.

    A path of length ρ contributes spreading(ρ) · exp(-(loss(f) + i wavenumber(f)) ρ), with ρ² = (horizontal distance)²
    + (depth of the microphone)². The paths are the direct path, the echoes from the four edges, which are image sources
    multiplied by `reflection`, and the echoes from the four corners, multiplied by the square of `reflection`. Echoes
    from the top and bottom faces are part of the spreading. The transfer functions include the gain of each microphone
    and, for a multiplexed readout, crosstalk and the delays of the sampling times.
    """
    skin_layer = skin.layer
    x, y = position
    layer_width, layer_height = skin_layer.width, skin_layer.height
    reflection_weights = jnp.array([1.0, skin_layer.reflection, skin_layer.reflection])
    x_offsets, y_offsets = (
        jnp.array([x, layer_width - x, -layer_width - x]),
        jnp.array([y, layer_height - y, -layer_height - y]),
    )
    squared_distances = (x_offsets[:, None] - skin.microphones[:, 0, None, None]) ** 2
    squared_distances += (y_offsets - skin.microphones[:, 1, None, None]) ** 2
    path_lengths = jnp.sqrt(squared_distances + skin.microphone_depth[:, None, None] ** 2).reshape(-1, 9)
    path_amplitudes = (
        jnp.outer(reflection_weights, reflection_weights).reshape(9)
        * skin_layer.spreading(path_lengths, skin.microphone_model.depth)
        * skin.gain[:, None]
    )
    complex_decay = skin_layer.material.loss(frequencies) + 1j * skin_layer.material.wavenumber(frequencies)
    received_amplitude = jnp.sum(path_amplitudes[..., None] * jnp.exp(-path_lengths[..., None] * complex_decay), axis=1)
    if not skin.readout.multiplexed:
        return received_amplitude
    # Microphone i is connected to slot i mod 4 of multiplexer i div 4. The slot read 25 µs earlier may have no
    # microphone.
    microphone_index = np.arange(skin.num_microphones)
    previous_channel = (
        microphone_index
        - microphone_index % NUM_MULTIPLEXER_CHANNELS
        + (microphone_index - 1) % NUM_MULTIPLEXER_CHANNELS
    )
    has_previous_channel = previous_channel < skin.num_microphones
    previous_channel_amplitude = jnp.where(
        has_previous_channel[:, None], received_amplitude[np.where(has_previous_channel, previous_channel, 0)], 0
    )
    received_amplitude += (
        skin.readout.coupling * previous_channel_amplitude * jnp.exp(-2j * jnp.pi * frequencies * MULTIPLEXER_INTERVAL)
    )
    return received_amplitude * jnp.exp(2j * jnp.pi * frequencies * skin.stagger[:, None])


def expected_power(skin: SoundingSkin, positions) -> Float[np.ndarray, "P M"]:
    """Mean square (P, M) of the samples of each of M channels without noise, for a steady source of strength 1 at each
    of `positions` (P, 2) in metres.

    The mean square is the integral over frequency of the source's spectral density times |transfer|², and is
    proportional to the square of the source's strength. Raises `ValueError` for positions outside the skin.
    """
    source_positions = skin.layer.check_inside("positions", positions)
    # Interference of two echoes makes |transfer|² oscillate with a period of at least 1 / (longest delay) in frequency.
    # Four frequencies per period make the sum nearly exact.
    frequency_step = min(1 / (4 * skin.layer.longest_delay), skin.readout.band[0] / 10)
    frequencies = np.arange(1, np.ceil(np.sqrt(2) * skin.readout.band[1] / frequency_step)) * frequency_step
    return np.asarray(_expected_power(skin, jnp.asarray(source_positions), jnp.asarray(frequencies), frequency_step))


@jax.jit
def _expected_power(skin, source_positions, frequencies, frequency_step):
    source_powers = source_density(skin, frequencies) * frequency_step
    return jax.lax.map(
        lambda source_position: jnp.abs(transfer(skin, frequencies, source_position)) ** 2 @ source_powers,
        source_positions,
    )


def nominal_power(skin: SoundingSkin, distances) -> Float[np.ndarray, " K"]:
    """Mean square (K,) of the signal received by a nominal microphone from a source of strength 1 at horizontal
    `distances` (K,) in metres, far from all edges."""
    return np.asarray(_nominal_power(skin, jnp.hypot(jnp.asarray(distances, float), skin.microphone_model.depth)))


@jax.jit
def _nominal_power(skin, path_lengths):
    frequencies = jnp.linspace(skin.readout.band[0] / 1.5, skin.readout.band[1] * 1.5, 2001)
    power_decay = jnp.exp(-2 * skin.layer.material.loss(frequencies) * path_lengths[..., None])
    return skin.layer.spreading(path_lengths, skin.microphone_model.depth) ** 2 * jnp.trapezoid(
        source_density(skin, frequencies) * power_decay, frequencies
    )


def noise_power(skin: SoundingSkin) -> Float[np.ndarray, " M"]:
    """Mean square (M,) of the noise of each microphone, which lies in the frequency band; see `MicrophoneModel`."""
    nominal_noise_power = nominal_power(skin, skin.microphone_model.reach) * 10 ** (-skin.microphone_model.snr_db / 10)
    return nominal_noise_power * np.asarray(skin.noise_factor)
