"""Sound intensities of recordings in a frequency band, corrected for background noise.

Band power of sound in sliding windows, and its distribution for white noise.

For a window x of N samples at rate r, with a Hann window w and X_k = Σ_n w_n x_n exp(-2πi kn/N), the band power is

    P = 2 / (N Σ w²) · Σ_k W_k |X_k|²,

W_k the part of bin k's own stretch of frequency, (k ± 1/2) r / N within 0 to r/2, that lies in the band. A sine of
amplitude A well inside the band has P = A²/2 (Parseval), and white noise of variance σ² has the mean
σ² · (high - low) / (r/2), wherever the edges of the band fall between bins. The mean of each window is removed; it
has no part in bins from 2 on, so that this holds exactly for low ≥ 1.5 / window.

P is a quadratic form xᵀAx. For white noise its mean is σ² tr A and its variance 2 σ⁴ tr A², so that it is distributed
nearly as mean · χ²_ν / ν, with ν = (tr A)² / tr A² degrees of freedom.

Intensity of sound: the band power of each microphone in sliding windows, above its noise floor.

A sine of amplitude A within the band has the intensity A²/2; white noise of variance σ² has σ² times the band's share
of the range from 0 to half the rate. `jeit.acoustic.signal.intensity` has the formulas and the variance of noise.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy.fft
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import gammainc, gammaincinv

from jeit.acoustic.signal.faults import intensity_faults, sample_faults, window_faults
from jeit.acoustic.signal.recording import Intensities, Recording, Taps
from jeit.arguments import check_kind

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


# A tap is audible in the windows with at least this fraction of its greatest loudness.
_AUDIBLE = 0.5


class IntensitySettings(eqx.Module):
    """Settings of intensity: the band `low` to `high`, Hz, and windows of `window` s that begin every `hop` s.

    The sound of touches on a soft skin is below 1 kHz; below 50 Hz are motions of the skin and of the arm that wears
    it. Raises `ValueError` for an invalid band, and for times that are not in seconds.
    """

    low: float = 50.0
    high: float = 1000.0
    window: float = 0.05
    hop: float = 0.0125

    def __check_init__(self):
        for name in ("low", "high", "window", "hop"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not np.isfinite(value):
                raise ValueError(f"{name} must be a finite number; it is {value!r}.")
        if not 0 <= self.low < self.high:
            raise ValueError(
                f"low= and high= must be a band in Hz, 0 ≤ low < high; they are {self.low} and {self.high}."
            )
        for name in ("window", "hop"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, in seconds; it is {getattr(self, name)}.")
        if self.hop > self.window:
            raise ValueError(
                f"hop must be no longer than a window, or sound between windows is lost; they are {self.hop} and "
                f"{self.window} s."
            )
        if self.window > 10:
            raise ValueError(f"window is {self.window} s, longer than any touch; give seconds (0.05, not 50 ms).")


def check_settings(name: str, settings: IntensitySettings | None) -> None:
    """Raises `ValueError`, about the argument `name`, for what are neither settings nor None."""
    if settings is not None:
        check_kind(name, settings, IntensitySettings, "IntensitySettings, such as IntensitySettings(window=0.05)")


class TapIntensities(NamedTuple):
    """Intensities of T taps at M microphones, as returned by `tap_intensities`.

    - `power`: (T, M) mean band power above the noise floor while the tap is audible; may be negative.
    - `floor`: (M,) noise power that was subtracted.
    - `freedom`: (T,) degrees of freedom ν of each mean, so that noise alone has the variance 2 floor² / ν.
    - `usable`: (T, M), `faults`: M strings, as in `Intensities`.
    """

    power: Float[np.ndarray, "T M"]
    floor: Float[np.ndarray, " M"]
    freedom: Float[np.ndarray, " T"]
    usable: Bool[np.ndarray, "T M"]
    faults: tuple[str, ...]


def intensities(
    recording: Recording, settings: IntensitySettings | None = None, floor: Float[np.ndarray, " M"] | None = None
) -> Intensities:
    """Intensities of a recording in sliding windows; windows with faults are marked as not usable.

    The noise floor (M,), in the square of the samples' unit, is estimated from the quietest windows, a fifth of which
    at least must be free of touch; give `floor` where it is known, from a recording of silence, or where the touch
    never pauses. Raises `ValueError` where band, window and recording do not fit each other.
    """
    check_kind("recording", recording, Recording, "a Recording of samples, as of read_recording(path)")
    check_settings("settings", settings)
    samples, rate = recording.samples, recording.rate
    grid = make_grid(settings or IntensitySettings(), rate, samples.shape[-1], recording.name)
    found = [
        window_faults(*sample_faults(channel, rate, recording.full_scale), grid.length, grid.hop) for channel in samples
    ]
    usable = np.stack([good for good, _ in found], axis=1)
    power = band_power(samples, grid)
    freedom = white_freedom(grid)
    noise = noise_floor(power, usable, freedom) if floor is None else _check_floor(floor, samples.shape[0])
    times = (grid.hop * np.arange(len(power)) + grid.length / 2) / rate
    faults = tuple(reason for _, reason in found)
    return Intensities(
        times,
        power - noise,
        floor=noise,
        freedom=freedom,
        overlap=grid.length / grid.hop,
        usable=usable,
        faults=faults,
        name=recording.name,
    )


def tap_intensities(taps: Taps, settings: IntensitySettings | None = None) -> TapIntensities:
    """Intensity of each tap at each microphone, for calibration.

    A tap's power is the mean over the windows in which it is audible, the same for all microphones: those in which the
    sum over microphones of power / floor, less that of noise, is at least half its maximum. A microphone with a fault
    in one of them is not usable for that tap: its mean over other windows would be of another loudness. The floor comes
    from the quietest windows of all taps, so that the taps should hold some silence, before or after. The windows
    overlap; `freedom` counts what they share exactly, for white noise. It does not account for the selection of
    windows: for a tap that is not audible at all, the loudest windows of noise are taken, somewhat above the floor.

    Taps that already hold intensities are returned as they are, with a floor of zero and infinite freedom. Raises
    `ValueError` for what is no `Taps`, and where band, window and samples do not fit each other.
    """
    check_kind("taps", taps, Taps, "Taps, as of read_taps(path)")
    check_settings("settings", settings)
    if taps.samples is None or taps.rate is None:
        assert taps.power is not None
        usable, faults = intensity_faults(taps.power)
        count, microphones = taps.power.shape
        return TapIntensities(taps.power, np.zeros(microphones), np.full(count, np.inf), usable, faults)
    samples, rate = taps.samples, taps.rate
    grid = make_grid(settings or IntensitySettings(), rate, samples.shape[-1], taps.name)
    good, faults = [], []
    for m in range(samples.shape[1]):
        # All taps of a microphone together: its range, its steps and its silence are the same throughout.
        kind, dead = sample_faults(samples[:, m].ravel(), rate, taps.full_scale)
        one, reason = window_faults(kind.reshape(-1, samples.shape[-1]), dead, grid.length, grid.hop)
        good.append(one)
        faults.append(reason)
    usable = np.stack(good, axis=-1)
    power = np.stack([band_power(tap, grid) for tap in samples])
    count, windows, microphones = power.shape
    freedom = white_freedom(grid)
    floor = noise_floor(power.reshape(-1, microphones), usable.reshape(-1, microphones), freedom)
    # A noiseless simulated channel would otherwise dominate; a dead channel is ignored.
    alive = usable.any(axis=(0, 1))
    least = np.maximum(floor, max(1e-9 * power.max(), np.finfo(float).tiny))
    loudness = np.where(alive, power / least - floor / least, 0).sum(axis=-1)
    audible = loudness >= _AUDIBLE * loudness.max(axis=1, keepdims=True)
    # Where no window is above the floor the rule selects too few or too many: include the loudest.
    audible |= loudness == loudness.max(axis=1, keepdims=True)
    mean = np.einsum("tf,tfm->tm", audible, power) / audible.sum(axis=1)[:, None]
    shared = shared_noise(grid, windows)
    each = np.array([freedom * one.sum() ** 2 / shared[np.ix_(one, one)].sum() for one in audible])
    whole = (usable | ~audible[..., None]).all(axis=1)
    return TapIntensities(mean - floor, floor, each, whole, tuple(faults))


def noise_floor(
    power: Float[np.ndarray, "F M"], usable: Bool[np.ndarray, "F M"], freedom: float, share: float = 0.2
) -> Float[np.ndarray, " M"]:
    """Noise floor (M,): mean band power of the noise, estimated from F windows of which some contain touches.

    At least the part `share` of the windows must be quiet. The start is a low quantile of the powers over that of χ²_ν
    / ν, as in minimum statistics (R. Martin, IEEE Trans. Speech Audio Process. 9, 504-512, 2001). That start is up to a
    few tenths too high when most windows are loud, since the share that is quiet is not known. So it is refined: the
    mean of the powers below c times the floor, divided by that mean for χ²_ν / ν truncated at c, repeated until
    convergence. `freedom` is ν; with ν infinite the low quantile is returned as it is. A channel without usable windows
    has the floor 0.

    Noise that is much louder at one end of the band scatters more than ν of white noise says, and its floor comes out
    low: for power as 1/f from 50 to 1000 Hz by 8 %, as 1/f² by a third.

    Raises `ValueError` for shapes that disagree, usable windows that are not finite, and a share or freedom out of
    range.
    """
    power, usable = np.asarray(power, float), np.asarray(usable)
    if power.ndim != 2 or usable.shape != power.shape or usable.dtype != bool:
        raise ValueError(
            f"power and usable must both be (windows, microphones), usable of booleans; they are {power.shape} and "
            f"{usable.shape} of {usable.dtype}."
        )
    if not 0 < share <= 1:
        raise ValueError(f"share must be a part of the windows, above 0 and up to 1; it is {share!r}.")
    if not freedom > 0:
        raise ValueError(f"freedom must be positive; it is {freedom!r}.")
    if not (np.isfinite(power) | ~usable).all():
        raise ValueError("power is NaN or infinite in windows that usable calls usable; mark those False.")
    number = usable.sum(axis=0)
    ordered = np.sort(np.where(usable, power, np.inf), axis=0)
    # The median of the windows that are certainly quiet.
    rank = np.clip(np.floor(0.5 * share * number).astype(int), 0, max(len(power) - 1, 0))
    floor = np.take_along_axis(ordered, rank[None], axis=0)[0] if len(power) else np.zeros(power.shape[1])
    floor = np.where(number > 0, floor, 0.0)
    if np.isinf(freedom):
        return floor
    half = freedom / 2
    # Quantiles of χ²_ν / ν, and its mean below the cut-off: ∫ y p(y) dy is the distribution function of ν + 2.
    floor = floor / (gammaincinv(half, 0.5 * share) / half)
    cut = gammaincinv(half, 0.9) / half
    below = gammainc(half + 1, half * cut) / 0.9
    for _ in range(50):
        quiet = usable & (power <= cut * floor)
        mean = np.where(quiet, power, 0).sum(axis=0) / np.maximum(quiet.sum(axis=0), 1) / below
        new = np.where(quiet.any(axis=0), mean, floor)
        if np.allclose(new, floor, rtol=1e-6, atol=0):
            break
        floor = new
    return floor


def degrees_of_freedom(settings: IntensitySettings, rate: float) -> float:
    """Degrees of freedom ν of one window's power of white noise sampled at `rate` Hz: its variance is exactly 2 mean² /
    ν."""
    return white_freedom(make_grid(settings, rate, None, "settings"))


def _check_floor(floor, microphones: int) -> Float[np.ndarray, " M"]:
    given = np.asarray(floor)
    if given.dtype.kind not in "fiu" or given.shape != (microphones,) or not (np.isfinite(given) & (given >= 0)).all():
        raise ValueError(
            f"floor must be finite and not negative, one for each of the {microphones} microphones; it is "
            f"{given.dtype} of shape {given.shape}."
        )
    return given.astype(float)
