"""Simulated air noise: a jet that blows on a skin, and the sound of the surrounding room."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.acoustic.simulate.checks import check_not_negative, check_positive
from jeit.acoustic.simulate.propagation import band_filter, noise_power, transfer
from jeit.acoustic.simulate.sound import SimulatedSound, block_times
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import (
    RINGING,
    bin_frequencies,
    filled_bins,
    microphone_noise,
    sample_times,
    transform_size,
)

# Number of positions that a jet consists of, and of frequencies at which their sum is computed; it is smooth in
# between.
_PLACES, _FREQUENCIES = 64, 160
# Kolmogorov's law of turbulence: the density of its energy falls as frequency to minus this.
TURBULENCE = 5 / 3


def wind(
    skin: SoundingSkin,
    key: Array,
    position: ArrayLike,
    *,
    strength: float = 1.0,
    radius: float = 0.03,
    gusts: float = 0.15,
    gust_time: float = 0.2,
    slope: float = TURBULENCE,
    duration: float = 1.0,
    noise: bool = True,
) -> SimulatedSound:
    """Simulate a steady jet of air about `position` (2,), metres, as of an air brush.

    Eddies press at 64 places, normal about `position` with a deviation of `radius` metres, each a source of its own,
    whose power density falls as frequency to minus `slope`; together their root mean square is `strength`. Eddies are
    much smaller than the spacing of the microphones, and no two microphones receive the same ones: each microphone
    receives the power that these positions give it, as independent noise. Loudness varies by `gusts`, the deviation of
    its logarithm, within `gust_time` seconds. Raises `ValueError` for a position off the skin, and for what is not
    positive.
    """
    check_skin_and_key(skin, key)
    middle = skin.layer.check_inside("position", [position])[0]
    for name, value in (("strength", strength), ("radius", radius), ("gust_time", gust_time), ("duration", duration)):
        check_positive(name, value)
    for name, value in (("gusts", gusts), ("slope", slope)):
        check_not_negative(name, value)
    where, gust, own, rest = jax.random.split(key, 4)
    half = np.array([skin.layer.width, skin.layer.height]) / 2
    places = np.clip(middle + radius * np.asarray(jax.random.normal(where, (_PLACES, 2))), -half, half)
    times = sample_times(skin, duration)
    loud = np.exp(gusts * _wavering(gust, len(times), gust_time * skin.rate) - gusts**2)
    density = _density(skin, slope, _received_power(skin, jnp.asarray(places), _grid(skin)))
    samples = strength * loud * _coloured(skin, own, density, len(times))
    if noise:
        samples = samples + microphone_noise(skin, rest, len(times))
    centres = block_times(skin, len(times))
    kept = centres[centres <= len(times) / skin.rate]
    return SimulatedSound(samples, skin.rate, np.tile(middle, (len(kept), 1)), kept, strength * loud, noise)


def room_sound(
    skin: SoundingSkin, key: Array, *, level_db: float = 0.0, slope: float = 1.0, duration: float = 1.0
) -> SimulatedSound:
    """Simulate the sound of a room: one signal received equally by all microphones, through air and mounting.

    `level_db`: its power beside the nominal microphone's own noise, decibels; its density falls as frequency to minus
    `slope`. Raises `ValueError` for a level that is not finite, a negative slope, and no duration.
    """
    check_skin_and_key(skin, key)
    check_positive("duration", duration)
    check_not_negative("slope", slope)
    if not np.isfinite(level_db):
        raise ValueError(f"level_db must be finite, in decibels; it is {level_db}.")
    times = sample_times(skin, duration)
    power = float(np.median(noise_power(skin) / np.asarray(skin.noise_factor))) * 10 ** (level_db / 10)
    one = _coloured(skin, key, power * _density(skin, slope, np.ones((1, _FREQUENCIES))), len(times))
    samples = np.asarray(skin.gain)[:, None] * one
    return SimulatedSound(samples, skin.rate, np.zeros((0, 2)), np.zeros(0), np.zeros(len(times)), False)


def _grid(skin: SoundingSkin) -> Float[np.ndarray, " G"]:
    """Frequencies over the band and half an octave beside it, Hz, evenly spaced in their logarithm."""
    low, high = skin.readout.band
    return np.geomspace(low / np.sqrt(2), high * np.sqrt(2), _FREQUENCIES)


@jax.jit
def _received_power(skin: SoundingSkin, places: Array, frequencies: Array) -> Array:
    """Power (M, G) received at each microphone from equal sources at all positions (P, 2), relative to that of the
    sources."""
    total = jnp.zeros((skin.microphones.shape[0], len(frequencies)))

    def add(index, total):
        return total + jnp.abs(transfer(skin, frequencies, places[index])) ** 2

    return jax.lax.fori_loop(0, len(places), add, total) / len(places)


def _density(skin: SoundingSkin, slope: float, received: ArrayLike) -> Float[np.ndarray, "M G"]:
    """Power densities, 1/Hz, received from sources of mean square 1 with the relative powers `received` (M, G)."""
    grid = _grid(skin)
    shape = np.asarray(band_filter(skin, jnp.asarray(grid))) * (grid / grid[0]) ** -slope
    return np.asarray(received) * shape / np.trapezoid(shape, grid)


def _coloured(skin: SoundingSkin, key: Array, density: Float[np.ndarray, "M G"], count: int) -> np.ndarray:
    """Simulate `count` samples (M, S) of independent noises of these densities."""
    size = transform_size(count, RINGING, skin.rate)
    bins = filled_bins(skin, size)
    frequencies = np.asarray(bin_frequencies(skin, size, bins))
    grid = _grid(skin)
    # Of a real signal of `size` samples, bin k > 0 with variance v_k adds 2 v_k / size² to the mean square.
    variance = np.stack([np.interp(frequencies, grid, one, left=0.0, right=0.0) for one in density])
    draws = np.asarray(jax.random.normal(key, (2, len(density), bins)))
    spectrum = np.sqrt(variance * skin.rate * size / 4) * (draws[0] + 1j * draws[1])
    return np.fft.irfft(spectrum, size)[:, :count]


def _wavering(key: Array, count: int, correlated: float) -> Float[np.ndarray, " S"]:
    """Slow normal noise (S,) of variance 1, correlated over `correlated` samples."""
    knots = int(np.ceil(count / correlated)) + 3
    values = np.asarray(jax.random.normal(key, (knots,)))
    # Between knots weights are the sine and cosine of one angle: the variance is 1 everywhere.
    at = np.arange(count) / correlated
    first = at.astype(int)
    angle = np.pi / 2 * (at - first)
    return np.cos(angle) * values[first] + np.sin(angle) * values[first + 1]
