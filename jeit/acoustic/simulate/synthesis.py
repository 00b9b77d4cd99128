"""Synthesis of noise with a given spectrum, and of bursts of noise.

The sound of a touch on soft rubber is modelled as band-limited random noise, steady or in bursts: white noise is
multiplied by an envelope and then filtered. All functions take an explicit random key, and the same key gives the same
samples.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import next_fast_len

from jeit.acoustic.simulate.propagation import band_filter, noise_power, source_density
from jeit.acoustic.simulate.sounding_skin import SoundingSkin
from jeit.arguments import check_kind
from jeit.arguments.checks import check_positive
from jeit_solvers.module import Module

# Duration in seconds for which the zero-phase filter of the source rings before and after a burst: about the inverse of
# the filter's lowest frequency.
RINGING_TIME = 0.05


def bin_frequencies(skin: SoundingSkin, num_samples: int, bins: int) -> Array:
    """Frequencies (bins,) in Hz of the lowest `bins` bins of a Fourier transform of `num_samples` samples."""
    return jnp.arange(bins) * (skin.rate / num_samples)


def num_filled_bins(skin: SoundingSkin, num_samples: int, *, blur: float = 0.0) -> int:
    """Number of bins of a real Fourier transform of `num_samples` samples up to half an octave above the band plus
    `blur` in Hz. The sound has zero amplitude in the remaining bins."""
    return min(int((np.sqrt(2) * skin.readout.band[1] + blur) * num_samples / skin.rate) + 1, num_samples // 2)


def transform_size(count: int, padding: float, rate: float) -> int:
    """Length in samples of a fast Fourier transform of `count` samples with at least `padding` seconds of zeros."""
    min_size = count + int(np.ceil(padding * rate))
    return 2 * int(np.asarray(next_fast_len((min_size + 1) // 2)))


def source_spectrum(skin: SoundingSkin, key: Array, envelope: Array, num_samples: int, bins: int) -> Array:
    """Fourier transform (bins,) of the sound of a source: white noise multiplied by `envelope`, and filtered to the
    spectral density of a source.

    Real white noise of variance 1 has the density 2 / rate at positive frequencies.
    """
    white = jnp.fft.rfft(jax.random.normal(key, envelope.shape) * envelope, num_samples)[:bins]
    return white * jnp.sqrt(source_density(skin, bin_frequencies(skin, num_samples, bins)) * skin.rate / 2)


def noise_spectrum(skin: SoundingSkin, key: Array, level: Array, num_samples: int, bins: int) -> Array:
    """Fourier transform (M, bins) of the noise of M microphones with mean square `level` (M,) and a flat spectrum in
    the band.

    In a real signal of `num_samples` samples, bin k > 0 with variance v_k contributes 2 v_k / size² to the mean square,
    where size is `num_samples`.
    """
    shape = band_filter(skin, bin_frequencies(skin, num_samples, bins))
    variance = level[:, None] * shape / jnp.sum(shape) * num_samples**2 / 2
    draws = jax.random.normal(key, (2, *variance.shape))
    return jnp.sqrt(variance / 2) * (draws[0] + 1j * draws[1])


@partial(jax.jit, static_argnums=(3, 4, 5))
def _noise_samples(skin, key, level, count, size, bins):
    return jnp.fft.irfft(noise_spectrum(skin, key, level, size, bins), size)[:, :count]


def microphone_noise(skin: SoundingSkin, key: Array, count: int) -> Float[np.ndarray, "M S"]:
    """Simulate `count` samples of noise of each microphone, (M, S) with S = `count`."""
    # Noise synthesised from a spectrum is periodic with period `size`. More samples than needed are generated, so that
    # the last samples are independent of the first.
    size = transform_size(count, RINGING_TIME, skin.rate)
    return np.asarray(_noise_samples(skin, key, noise_power(skin), count, size, num_filled_bins(skin, size)))


def sample_times(skin: SoundingSkin, duration: float) -> Float[np.ndarray, " S"]:
    """Sampling times (S,) of the first channel in seconds, for a recording of `duration` seconds."""
    return np.arange(max(2, round(duration * skin.rate))) / skin.rate


# Time in seconds at which the first burst of a recording begins, which leaves room for the ringing of the filter.
FIRST_ONSET = 0.02


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
        if duration < FIRST_ONSET + self.length:
            raise ValueError(
                f"duration: a burst of {self.length:g} s that begins at {FIRST_ONSET:g} s does not fit in {duration:g} "
                f"s. Give at least {FIRST_ONSET + self.length:g} s, or a shorter length."
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
        elapsed = np.maximum(times - onsets[:, None], 0)
        shape = elapsed * np.exp(-elapsed / rise_time) / np.sqrt(rise_time**3 / 4 / self.length)
        # Overlapping bursts are treated as independent noises, so the powers of the bursts add.
        return np.sqrt(((strengths[:, None] * shape) ** 2).sum(axis=0))


def check_burst(burst: Burst, duration: float) -> None:
    """Raises `ValueError` if `burst` is not a `Burst`, or if a recording of `duration` seconds is too short for one
    burst."""
    check_kind("burst", burst, Burst, "a Burst, such as Burst(strength=2.0)")
    burst.check_fits(duration)


# Bursts of a vibrator with a rubber tip, of the palm of a hand, and of tickling fingers.
VIBRATOR_BURST, FIRM_BURST, LIGHT_BURST = Burst(), Burst(2.0, 0.08), Burst(0.7, 0.04)
