"""Synthesis of noise with a spectrum, and of bursts.

A touch of soft rubber is random noise in a band, in bursts or steadily. White noise is shaped in time first and in
frequency after. Every function takes an explicit key: the same key, the same samples.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import next_fast_len

from jeit.acoustic.simulate.checks import check_positive
from jeit.acoustic.simulate.propagation import band_filter, noise_power, source_density
from jeit.acoustic.simulate.sounding_skin import SoundingSkin
from jeit.arguments import check_kind

# The source's filter has no phase: it rings before and after a burst, for about the inverse of its lowest frequency.
RINGING = 0.05


def bin_frequencies(skin: SoundingSkin, size: int, bins: int) -> Array:
    """The lowest `bins` frequencies (bins,), Hz, of a transform of `size` samples."""
    return jnp.arange(bins) * (skin.rate / size)


def filled_bins(skin: SoundingSkin, size: int, *, blur: float = 0.0) -> int:
    """Number of nonzero bins of a real transform of `size` samples: half an octave over the band, and `blur`."""
    return min(int((np.sqrt(2) * skin.readout.band[1] + blur) * size / skin.rate) + 1, size // 2)


def transform_size(count: int, padding: float, rate: float) -> int:
    """A fast transform length for `count` samples and at least `padding` seconds of zeros."""
    needed = count + int(np.ceil(padding * rate))
    return 2 * int(np.asarray(next_fast_len((needed + 1) // 2)))


def source_spectrum(skin: SoundingSkin, key: Array, envelope: Array, size: int, bins: int) -> Array:
    """Transform (bins,) of white noise under `envelope`, filtered to the source's density.

    Real noise of variance 1 has the density 2 / rate over its positive frequencies.
    """
    white = jnp.fft.rfft(jax.random.normal(key, envelope.shape) * envelope, size)[:bins]
    return white * jnp.sqrt(source_density(skin, bin_frequencies(skin, size, bins)) * skin.rate / 2)


def noise_spectrum(skin: SoundingSkin, key: Array, level: Array, size: int, bins: int) -> Array:
    """Transform (M, bins) of noise of mean square `level` (M,), flat in the band.

    Of a real signal of `size` samples, bin k > 0 with variance v_k adds 2 v_k / size² to the mean square.
    """
    shape = band_filter(skin, bin_frequencies(skin, size, bins))
    variance = level[:, None] * shape / jnp.sum(shape) * size**2 / 2
    draws = jax.random.normal(key, (2, *variance.shape))
    return jnp.sqrt(variance / 2) * (draws[0] + 1j * draws[1])


@partial(jax.jit, static_argnums=(3, 4, 5))
def _noise_samples(skin, key, level, count, size, bins):
    return jnp.fft.irfft(noise_spectrum(skin, key, level, size, bins), size)[:, :count]


def microphone_noise(skin: SoundingSkin, key: Array, count: int) -> Float[np.ndarray, "M S"]:
    """Simulate `count` samples (M, S) of the microphones' own noise."""
    # Noise made from a spectrum repeats after `size` samples; a tail that is cut off parts its end from its beginning.
    size = transform_size(count, RINGING, skin.rate)
    return np.asarray(_noise_samples(skin, key, noise_power(skin), count, size, filled_bins(skin, size)))


def sample_times(skin: SoundingSkin, duration: float) -> Float[np.ndarray, " S"]:
    """Sampling times of the first channel in `duration` seconds, (S,) s."""
    return np.arange(max(2, round(duration * skin.rate))) / skin.rate


# When the first burst begins, seconds: time for its ringing.
ONSET = 0.02


class Burst(eqx.Module):
    """Envelope of one tap: it rises fast and decays within `length` seconds, over which its root mean square is
    `strength`. Raises `ValueError` for what is not positive."""

    strength: float = 1.0
    length: float = 0.06

    def __check_init__(self):
        check_positive("strength", self.strength)
        check_positive("length", self.length)

    def check_fits(self, duration: float) -> None:
        """Raises `ValueError` unless a recording of `duration` seconds holds one burst."""
        check_positive("duration", duration)
        if duration < ONSET + self.length:
            raise ValueError(
                f"duration: a burst of {self.length:g} s that begins at {ONSET:g} s does not fit in {duration:g} s. "
                f"Give at least {ONSET + self.length:g} s, or a shorter length."
            )

    def envelope(
        self, times: Float[np.ndarray, " S"], onsets: Float[np.ndarray, " N"], strengths: Float[np.ndarray, " N"]
    ) -> Float[np.ndarray, " S"]:
        """Root mean square at `times` (s) of N bursts of this length that begin at `onsets` (s), with `strengths`.

        A burst is t e^(-t / a), a = length / 6: risen in a sixth of `length`, at its end down to 4 %. Its square,
        t² e^(-2t / a), integrates to a³ / 4: divided by `length`, that is the mean square to scale by.
        """
        rise = self.length / 6
        after = np.maximum(times - onsets[:, None], 0)
        shape = after * np.exp(-after / rise) / np.sqrt(rise**3 / 4 / self.length)
        # Bursts that overlap are independent noises: their powers add.
        return np.sqrt(((strengths[:, None] * shape) ** 2).sum(axis=0))


def check_burst(burst: Burst, duration: float) -> None:
    """Raises `ValueError` for what is no `Burst`, and unless a recording of `duration` seconds holds one of it."""
    check_kind("burst", burst, Burst, "a Burst, such as Burst(strength=2.0)")
    burst.check_fits(duration)


# A vibrator with a rubber tip, the palm of a hand, and fingers that tickle.
VIBRATOR, FIRM, LIGHT = Burst(), Burst(2.0, 0.08), Burst(0.7, 0.04)
