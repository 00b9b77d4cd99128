"""Park 2022 as one writes it plainly: a / (r² + b) of each microphone by least squares of logarithms, and the least
pixel of the loss, whatever the array sounds like. It refuses nothing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Values of b that are tried, as parts of the square of the skin's longer side, and rounds with the taps' strengths.
_TRIED, _ROUNDS = np.geomspace(1e-6, 1.0, 40), 10


class PlainConsistency:
    """For one array: microphones (M, 2), corners of a rectangle (4, 2), intensities (T, M) of taps at places (T, 2)."""

    def __init__(self, microphones, outline, places, power, pixels: int = 100):
        self.microphones = microphones
        self.heard = (power > 0).mean(axis=0) > 0.2
        squared = ((places[:, None] - microphones) ** 2).sum(axis=-1)
        tried = _TRIED * np.ptp(outline, axis=0).max() ** 2
        known = np.where((power > 0) & self.heard, np.log(np.maximum(power, 1e-300)), np.nan)
        # (B, T, M): what is left of a logarithm once the decay is taken out.
        left = known + np.log(squared + tried[:, None, None])
        self.b = np.full(len(microphones), tried[len(tried) // 2])
        self.a = np.ones(len(microphones))
        for _ in range(_ROUNDS):
            told = known + np.log((squared + self.b) / self.a)
            strength = np.nan_to_num(_median(told, 1))[:, None]
            spread = left - strength
            cost = np.nanmean((spread - np.nanmean(spread, axis=1, keepdims=True)) ** 2, axis=1)[:, self.heard]
            self.b[self.heard] = tried[cost.argmin(axis=0)]
            best = known + np.log(squared + self.b) - strength
            self.a = np.exp(np.nan_to_num(np.nanmean(best, axis=0)))
        low, high = outline.min(axis=0), outline.max(axis=0)
        axes = [np.linspace(low[k], high[k], pixels) for k in range(2)]
        self.pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        away = ((self.pixels[:, None] - microphones) ** 2).sum(axis=-1)
        self.inverse = ((away + self.b) / self.a)[:, self.heard]

    def __call__(self, power: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N 2"]:
        """The place of each touch."""
        heard = power[:, self.heard]
        found = np.empty((len(heard), 2))
        for k, one in enumerate(heard):
            told = one / one.max() * self.inverse
            found[k] = self.pixels[((told[:, [one.argmax()]] - told) ** 2).sum(axis=1).argmin()]
        return found


def _median(values, axis):
    kept = np.isfinite(values).any(axis=axis)
    result = np.full(kept.shape, np.nan)
    result[kept] = np.nanmedian(values[kept], axis=axis)
    return result
