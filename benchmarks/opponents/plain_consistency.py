"""Plain implementation of the localisation of Park et al. (2022) for any array: the decay a / (r² + b) of each
microphone is fitted by least squares of logarithms, and a touch is located at the pixel of least loss.

The implementation refuses no array.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Trial values of b, as fractions of the square of the skin's longer side, and number of iterations that alternate with
# the estimation of the taps' strengths.
_TRIED, _ROUNDS = np.geomspace(1e-6, 1.0, 40), 10


class PlainConsistency:
    """Localiser for one array: M microphones (M, 2), corners of a rectangle (4, 2), intensities (T, M) of T taps at
    places (T, 2)."""

    def __init__(self, microphones, outline, places, power, pixels: int = 100):
        self.microphones = microphones
        self.received = (power > 0).mean(axis=0) > 0.2
        squared = ((places[:, None] - microphones) ** 2).sum(axis=-1)
        tried = _TRIED * np.ptp(outline, axis=0).max() ** 2
        known = np.where((power > 0) & self.received, np.log(np.maximum(power, 1e-300)), np.nan)
        # Residual (B, T, M) of the logarithm of intensity after removal of the decay, for B trial values of b.
        left = known + np.log(squared + tried[:, None, None])
        self.b = np.full(len(microphones), tried[len(tried) // 2])
        self.a = np.ones(len(microphones))
        for _ in range(_ROUNDS):
            log_strength = known + np.log((squared + self.b) / self.a)
            strength = np.nan_to_num(_median(log_strength, 1))[:, None]
            spread = left - strength
            cost = np.nanmean((spread - np.nanmean(spread, axis=1, keepdims=True)) ** 2, axis=1)[:, self.received]
            self.b[self.received] = tried[cost.argmin(axis=0)]
            best = known + np.log(squared + self.b) - strength
            self.a = np.exp(np.nan_to_num(np.nanmean(best, axis=0)))
        low, high = outline.min(axis=0), outline.max(axis=0)
        axes = [np.linspace(low[k], high[k], pixels) for k in range(2)]
        self.pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        away = ((self.pixels[:, None] - microphones) ** 2).sum(axis=-1)
        self.inverse = ((away + self.b) / self.a)[:, self.received]

    def __call__(self, power: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N 2"]:
        """Position (touches, 2) of each touch, from intensities `power` (touches, microphones)."""
        received = power[:, self.received]
        found = np.empty((len(received), 2))
        for k, one in enumerate(received):
            strength = one / one.max() * self.inverse
            found[k] = self.pixels[((strength[:, [one.argmax()]] - strength) ** 2).sum(axis=1).argmin()]
        return found


def _median(values, axis):
    kept = np.isfinite(values).any(axis=axis)
    result = np.full(kept.shape, np.nan)
    result[kept] = np.nanmedian(values[kept], axis=axis)
    return result
