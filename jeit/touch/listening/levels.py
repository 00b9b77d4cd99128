"""Convert powers to levels on a common scale, as input of a network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.touch.listening.feature_images import SoundImages

# Decibels below the loudest that are resolved; and the share of powers that are no louder than that.
_RANGE, _LOUDEST = 60.0, 0.999


@dataclass(frozen=True)
class Levels:
    """Scale from powers to standardised levels in decibels, first of intensities, then of spectrograms.

    Levels are clipped at 60 dB below the `loudest` (2,) of the training set (all but a thousandth of it is no louder),
    then standardised by their `mean` (2,) and `deviation` (2,). One scale holds for all rows, so that a louder window
    has greater values.
    """

    loudest: Float[np.ndarray, " 2"]
    mean: Float[np.ndarray, " 2"]
    deviation: Float[np.ndarray, " 2"]

    @classmethod
    def of(cls, images: SoundImages) -> "Levels":
        """Compute the scale from windows of the training set."""
        loudest, mean, deviation = [], [], []
        for power in (images.intensity, images.spectrum):
            top = _decibels(np.quantile(power, _LOUDEST), -np.inf)
            levels = _decibels(power, float(top) - _RANGE)
            loudest.append(float(top))
            mean.append(float(levels.mean(dtype=float)))
            deviation.append(float(levels.std(dtype=float)) or 1.0)
        return cls(np.array(loudest), np.array(mean), np.array(deviation))

    def __call__(self, images: SoundImages) -> Float[np.ndarray, "W rows 41"]:
        """Feature images (W, M + 64, 41), single precision: M rows of intensity, then 64 of the spectrogram.

        Microphones are sorted by their loudness in the window, the loudest first: the paper does not state their order,
        and so a touch looks the same wherever it is.
        """
        order = np.argsort(-images.intensity.sum(axis=2), axis=1, kind="stable")
        intensity = np.take_along_axis(images.intensity, order[..., None], axis=1)
        parts = [
            (_decibels(power, self.loudest[part] - _RANGE) - self.mean[part]) / self.deviation[part]
            for part, power in enumerate((intensity, images.spectrum))
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)


def _decibels(power, least: float) -> np.ndarray:
    """Decibels of powers, no less than `least`; silence, which has no level, is 300 dB below full scale."""
    return np.maximum(10 * np.log10(np.maximum(power, 1e-30)), least)
