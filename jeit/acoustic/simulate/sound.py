"""Simulated recordings: the channels' samples for a source, with its true position and amplitude.

A touch of envelope e(t) at one place is received, on average over keys, with the energy Σ e² times `expected_power`,
but for what rings on beyond the recording's ends.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.acoustic.simulate.checks import check_positive
from jeit.acoustic.simulate.propagation import transfer
from jeit.acoustic.simulate.sounding_skin import SoundingSkin, check_skin_and_key
from jeit.acoustic.simulate.synthesis import (
    RINGING,
    bin_frequencies,
    filled_bins,
    microphone_noise,
    sample_times,
    source_spectrum,
    transform_size,
)

# A moving source stands still for one Hann block of two hops; the blocks overlap by half and sum to one. In 10 ms a
# brisk stroke of 0.5 m/s moves by 5 mm, well under the distances over which loudness changes.
HOP = 0.01


class SimulatedSound(eqx.Module):
    """Samples of the channels of a skin during a touch, and the true source.

    **Fields**: `samples` (M, S), in units of the skin's sources; `rate`, samples per second; `position` (N, 2) metres,
    where the source is (or was last, or will be first) at `position_times` (N,), seconds; N is 0 for `quiet`. `active`
    (S,): the source's root mean square at `times`, when it leaves the source. `noisy`: whether noise was added.
    """

    samples: Float[np.ndarray, "M S"]
    rate: float
    position: Float[np.ndarray, "N 2"]
    position_times: Float[np.ndarray, " N"]
    active: Float[np.ndarray, " S"]
    noisy: bool = eqx.field(static=True)

    @property
    def times(self) -> np.ndarray:
        """Sampling times of the first channel, (S,) seconds from the start; the others follow by `skin.stagger`."""
        return np.arange(self.samples.shape[1]) / self.rate


def quiet(skin: SoundingSkin, key: Array, *, duration: float = 1.0) -> SimulatedSound:
    """Simulate the microphones' own noise only, for `duration` seconds. Raises `ValueError` for an invalid duration."""
    check_skin_and_key(skin, key)
    check_positive("duration", duration)
    times = sample_times(skin, duration)
    samples = microphone_noise(skin, key, len(times))
    return SimulatedSound(samples, skin.rate, np.zeros((0, 2)), np.zeros(0), np.zeros(len(times)), True)


def superpose(skin: SoundingSkin, key: Array | None, *recordings: SimulatedSound) -> Float[np.ndarray, "M S"]:
    """Samples (M, S) of several touches at once, the microphones' noise added once; with key None, none is.

    The recordings must be of one skin and length and made with `noise=False`, or noise would count twice: `ValueError`.
    """
    check_skin_and_key(skin, jax.random.key(0) if key is None else key)
    if not recordings:
        raise ValueError("recordings: give at least one.")
    if any(recording.noisy for recording in recordings):
        raise ValueError("recordings: make them with noise=False; noise is added once, here.")
    shapes = {(recording.samples.shape, recording.rate) for recording in recordings}
    if len(shapes) > 1 or recordings[0].samples.shape[0] != skin.num_microphones or recordings[0].rate != skin.rate:
        raise ValueError(
            f"recordings: all must come from this skin and last equally long; shapes and rates are {shapes}."
        )
    together = np.sum([recording.samples for recording in recordings], axis=0)
    return together if key is None else together + microphone_noise(skin, key, together.shape[1])


def record(skin: SoundingSkin, key: Array, places: np.ndarray, envelope: np.ndarray, noise: bool) -> SimulatedSound:
    """Simulate the samples for a source of root mean square `envelope` (S,), in the blocks at `places` (B, 2), or (1,
    2)."""
    source, own = jax.random.split(key)
    count, centres = len(envelope), block_times(skin, len(envelope))
    places = np.broadcast_to(places, (len(centres), 2))
    whole = transform_size(count, RINGING, skin.rate)
    block = transform_size(2 * round(HOP * skin.rate), skin.layer.longest_delay, skin.rate)
    samples = np.asarray(_moving(skin, source, places, envelope, whole, block, filled_bins(skin, block, blur=4 / HOP)))
    if noise:
        samples = samples + microphone_noise(skin, own, count)
    kept = centres <= count / skin.rate
    return SimulatedSound(samples, skin.rate, np.array(places[kept]), centres[kept], envelope, noise)


def block_times(skin: SoundingSkin, count: int) -> np.ndarray:
    """The middles of the blocks that cover `count` samples, seconds: 0, one hop, two hops, ..."""
    return HOP * np.arange(int(np.ceil(count / round(HOP * skin.rate))) + 1)


@partial(jax.jit, static_argnums=(4, 5, 6))
def _moving(skin, key, places, envelope, whole, block, bins):
    count, hop = envelope.shape[0], round(HOP * skin.rate)
    sound = jnp.fft.irfft(source_spectrum(skin, key, envelope, whole, whole // 2 + 1), whole)[:count]
    sound = jnp.pad(sound, (hop, places.shape[0] * hop + hop - count))
    window = jnp.sin(jnp.pi * jnp.arange(2 * hop) / (2 * hop)) ** 2
    frequencies = bin_frequencies(skin, block, bins)

    def step(output, item):
        index, place = item
        piece = jax.lax.dynamic_slice(sound, (index * hop,), (2 * hop,)) * window
        spectrum = jnp.fft.rfft(piece, block)[:bins] * transfer(skin, frequencies, place)
        here = jax.lax.dynamic_slice(output, (0, index * hop), (output.shape[0], block))
        return jax.lax.dynamic_update_slice(output, here + jnp.fft.irfft(spectrum, block), (0, index * hop)), None

    output = jnp.zeros((skin.num_microphones, places.shape[0] * hop + block))
    output, _ = jax.lax.scan(step, output, (jnp.arange(places.shape[0]), places))
    return output[:, hop : hop + count]
