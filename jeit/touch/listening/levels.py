"""Powers as levels on a common scale: what a network is shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.touch.listening.feature_images import SoundImages

# Decibels below the loudest in which differences are told; and the share of powers that are no louder than that.
_RANGE, _LOUDEST = 60.0, 0.999


@dataclass(frozen=True)
class Levels:
    """Decibels, no less than 60 below the `loudest` (2,) of what was learnt from (all but a thousandth of it is no
    louder), less their `mean` (2,), over their `deviation` (2,): first of intensities, then of spectrograms. So one
    scale holds for all rows, and a window that is louder than another looks louder."""

    loudest: Float[np.ndarray, " 2"]
    mean: Float[np.ndarray, " 2"]
    deviation: Float[np.ndarray, " 2"]

    @classmethod
    def of(cls, images: SoundImages) -> "Levels":
        """Those of windows that are learnt from."""
        loudest, mean, deviation = [], [], []
        for power in (images.intensity, images.spectrum):
            top = _decibels(np.quantile(power, _LOUDEST), -np.inf)
            levels = _decibels(power, float(top) - _RANGE)
            loudest.append(float(top))
            mean.append(float(levels.mean(dtype=float)))
            deviation.append(float(levels.std(dtype=float)) or 1.0)
        return cls(np.array(loudest), np.array(mean), np.array(deviation))

    def __call__(self, images: SoundImages) -> Float[np.ndarray, "W rows 41"]:
        """Feature images (W, M + 64, 41), single precision: the M rows of intensity, then 64 of the spectrogram.

        The microphone that is loudest in the window comes first, then the next: the paper does not say in which order
        they stand, and so a touch looks the same wherever it is.
        """
        order = np.argsort(-images.intensity.sum(axis=2), axis=1, kind="stable")
        intensity = np.take_along_axis(images.intensity, order[..., None], axis=1)
        parts = [
            (_decibels(power, self.loudest[part] - _RANGE) - self.mean[part]) / self.deviation[part]
            for part, power in enumerate((intensity, images.spectrum))
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)


def _decibels(power, least: float) -> np.ndarray:
    """Of powers, no less than `least`; silence, which has no level, is 300 dB below full scale."""
    return np.maximum(10 * np.log10(np.maximum(power, 1e-30)), least)
