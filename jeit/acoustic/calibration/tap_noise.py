"""Noise of each microphone, estimated from the residuals of a calibration: relative error and additive deviation.

Arrays are (M, T): M microphones, T taps. Residuals are of levels, log(power + floor).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.noise import LEAST_RELATIVE, IntensityNoise

# Residuals beyond so many standard deviations are excluded from the noise estimate.
_BEYOND = 4.0
# Number of taps that the median of all microphones counts as, in the noise of each.
_DRAWN = 20.0
# Least number of taps to estimate additive noise from.
_FEW = 8


def relative_errors(
    noise: IntensityNoise,
    received: Float[np.ndarray, "M T"],
    residual: Float[np.ndarray, "M T"],
    use: Bool[np.ndarray, "M T"],
    inflation: float,
) -> Float[np.ndarray, " M"]:
    """Relative error τ of each microphone, from the moments of its residuals beyond the floor's noise, without
    outliers.

    `received`: expected power; `inflation`: correction of the squared residuals for the fitted parameters. Each
    estimate is shrunk towards the median of all microphones, which counts as a few more taps: with few taps the moments
    may be zero or negative.
    """
    floor, rest, cross = (np.asarray(x) for x in (noise.floor, noise.deviation, noise.cross))
    seen, excess = np.zeros(len(received)), np.zeros(len(received))
    for k in range(len(received)):
        used = use[k] & (received[k] > 3 * rest[k])
        if used.sum() < 3:
            continue
        signal, off = received[k, used], residual[k, used]
        share = (signal / (signal + floor[k])) ** 2
        other = (cross[k] * signal + rest[k] ** 2) / (signal + floor[k]) ** 2
        near = np.abs(off) <= _BEYOND * max(1.4826 * np.median(np.abs(off)), 1e-15)
        for _ in range(3):
            near = np.abs(off) <= _BEYOND * np.sqrt(np.mean(off[near] ** 2))
        seen[k] = near.sum()
        excess[k] = (inflation * np.mean(off[near] ** 2) - np.mean(other[near])) / np.mean(share[near])
    if not seen.any():
        return np.full(len(received), 0.5)
    typical = max(float(np.median(excess[seen > 0])), 0.0)
    drawn = (seen * np.minimum(excess, 1.0) + _DRAWN * typical) / (seen + _DRAWN)
    return np.sqrt(np.maximum(drawn, LEAST_RELATIVE**2))


def additive_deviations(
    power: Float[np.ndarray, "M T"], received: Float[np.ndarray, "M T"], use: Bool[np.ndarray, "M T"], inflation: float
) -> Float[np.ndarray, " M"]:
    """Additive deviation s of each microphone, where only intensities are known: its reading without a source.

    The maximum-likelihood pair of relative and additive deviation, on a grid and a finer one about the best; 0 unless
    that is clearly better than none. The estimate is at least half the median of all microphones: few taps determine
    the noise poorly, and a microphone whose noise is underestimated causes false detections.
    """
    deviation = np.zeros(len(received))
    coarse = np.concatenate([[0.0], np.geomspace(1e-6, 0.5, 18)])
    scatter = np.geomspace(LEAST_RELATIVE, 1.0, 30)
    for k in range(len(received)):
        if use[k].sum() < _FEW:
            continue
        read, signal = power[k, use[k]], received[k, use[k]]
        top = np.abs(read).max()
        if top == 0:
            continue

        def score(shares, read=read, signal=signal, top=top):
            trial = (scatter[:, None, None] * signal) ** 2 + (top * shares[:, None]) ** 2 + 1e-30 * top**2
            ratio = np.minimum(inflation * (read - signal) ** 2 / trial, _BEYOND**2)
            return np.sum(ratio + np.log(trial), axis=-1).min(axis=0)

        scores = score(coarse)
        best = int(scores.argmin())
        if scores[best] < scores[0] - 6:
            near = coarse[best] * np.geomspace(0.5, 2.0, 9)
            deviation[k] = top * near[score(near).argmin()]
    judged = use.sum(axis=1) >= _FEW
    typical = float(np.median(deviation[judged])) if judged.any() else 0.0
    return np.where(judged, np.maximum(deviation, 0.5 * typical), deviation)
