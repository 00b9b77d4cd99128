"""Band power of sound in sliding windows, and its distribution for white noise.

For a window x of N samples at rate r, with a Hann window w and X_k = Σ_n w_n x_n exp(-2πi kn/N), the band power is

    P = 2 / (N Σ w²) · Σ_k W_k |X_k|²,

W_k the part of bin k's own stretch of frequency, (k ± 1/2) r / N within 0 to r/2, that lies in the band. A sine of
amplitude A well inside the band has P = A²/2 (Parseval), and white noise of variance σ² has the mean
σ² · (high - low) / (r/2), wherever the edges of the band fall between bins. The mean of each window is removed; it
has no part in bins from 2 on, so that this holds exactly for low ≥ 1.5 / window.

P is a quadratic form xᵀAx. For white noise its mean is σ² tr A and its variance 2 σ⁴ tr A², so that it is distributed
nearly as mean · χ²_ν / ν, with ν = (tr A)² / tr A² degrees of freedom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

# Least number of bins in the band.
_FEWEST_BINS = 4.0
# Samples transformed at a time: 2 MiB, which fits into the cache with the transforms.
_CHUNK = 2**18


class Grid(NamedTuple):
    """Windows in samples; the Hann window (N,); weights W_k (K,) of bins from `first` on, with the factor of P."""

    length: int
    hop: int
    taper: np.ndarray
    first: int
    weights: np.ndarray


def make_grid(settings, rate: float, samples: int | None, name: str) -> Grid:
    """Windows of `IntensitySettings` at `rate` Hz; raises `ValueError` where band, window and rate do not fit."""
    length, hop = round(settings.window * rate), max(1, round(settings.hop * rate))
    if settings.high > rate / 2:
        raise ValueError(
            f"{name}: the band {settings.low:g} to {settings.high:g} Hz reaches beyond half the rate of {rate:g} Hz; "
            f"set high to {rate / 2:g} Hz or less."
        )
    bins = (settings.high - settings.low) * length / rate
    if bins < _FEWEST_BINS:
        raise ValueError(
            f"{name}: a window of {settings.window:g} s resolves frequencies {1 / settings.window:.3g} Hz apart: too "
            f"few in the band {settings.low:g} to {settings.high:g} Hz. Set window to "
            f"{_FEWEST_BINS / (settings.high - settings.low):.2g} s or more, or widen the band."
        )
    if samples is not None and samples < length:
        raise ValueError(
            f"{name}: {samples} samples at {rate:g} Hz last {samples / rate:.3g} s, less than one window of "
            f"{settings.window:g} s. Record longer, or shorten window=."
        )
    # Periodic, not symmetric: then its transform is zero but for three bins.
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    edges = np.clip((np.arange(length // 2 + 2) - 0.5) * rate / length, 0, rate / 2)
    overlap = np.clip(edges, settings.low, settings.high)
    weights = np.diff(overlap) * length / rate
    (used,) = np.nonzero(weights)
    weights = weights[used[0] : used[-1] + 1] * 2 / (length * (taper**2).sum())
    return Grid(length, hop, taper, int(used[0]), weights)


def band_power(samples: np.ndarray, grid: Grid) -> np.ndarray:
    """(F, M) band power of samples (M, S)."""
    finite = np.isfinite(samples)
    if not finite.all():
        # Windows with these samples are not usable: the value does not matter.
        samples = np.where(finite, samples, 0)
    # A large constant would lose digits; its remainder in each window is removed below.
    samples = samples - samples.mean(axis=1, keepdims=True, dtype=float)
    windows = sliding_window_view(samples, grid.length, axis=-1)[:, :: grid.hop]
    count, number = windows.shape[:2]
    power = np.empty((number, count))
    last = grid.first + len(grid.weights)
    step = max(1, _CHUNK // (count * grid.length))
    constant = np.fft.rfft(grid.taper)[grid.first : last]
    room = np.empty(count * min(step, number) * grid.length)
    for start in range(0, number, step):
        part = windows[:, start : start + step]
        tapered = np.multiply(part, grid.taper, out=room[: part.size].reshape(part.shape))
        spectrum = np.asarray(scipy.fft.rfft(tapered, workers=2))[..., grid.first : last]
        if grid.first < 2:
            # Elsewhere the Hann window's own transform is zero, and the mean with it.
            spectrum = spectrum - part.mean(axis=-1)[..., None] * constant
        power[start : start + step] = ((np.real(spectrum) ** 2 + np.imag(spectrum) ** 2) @ grid.weights).T
    return power


def _trace(grid: Grid, lag: int) -> float:
    """tr(A_0 A_lag) of two windows `lag` samples apart: half the covariance of their powers for noise of variance 1.

    With g(d) = Σ_k W_k cos(2πkd/N), A_nm = w_n w_m g(n - m), of period N in n - m. So the trace is Σ_d g(d)² r(d) with
    r the autocorrelation of u_n = w_n w_(n+lag) where both windows reach: no N × N matrix is needed.
    """
    weights = np.zeros(grid.length // 2 + 1)
    weights[grid.first : grid.first + len(grid.weights)] = grid.weights
    # The inverse transform counts bins between the ends twice.
    weights[1 : (grid.length + 1) // 2] /= 2
    squared = (grid.length * np.fft.irfft(weights, grid.length)) ** 2
    both = np.zeros(grid.length)
    both[: grid.length - lag] = grid.taper[: grid.length - lag] * grid.taper[lag:]
    correlation = np.fft.irfft(np.abs(np.fft.rfft(both)) ** 2, grid.length)
    return float((squared * correlation).sum())


def white_freedom(grid: Grid) -> float:
    """Degrees of freedom ν of one window's power of white noise; exact except for the mean's removal in bins 0 and
    1."""
    # tr A = Σ w² Σ W, with the factor of P in the weights already.
    return float(((grid.taper**2).sum() * grid.weights.sum()) ** 2 / _trace(grid, 0))


def shared_noise(grid: Grid, windows: int) -> Float[np.ndarray, "F F"]:
    """Correlation of the powers of white noise in windows i and j."""
    overlapping = range(min(windows, -(-grid.length // grid.hop)))
    by_lag = np.zeros(windows)
    by_lag[: len(overlapping)] = [_trace(grid, j * grid.hop) for j in overlapping]
    between = np.abs(np.arange(windows)[:, None] - np.arange(windows))
    return by_lag[between] / by_lag[0]
