"""Sound intensity: the band power of each microphone in sliding windows, minus its noise floor.

For a window x of N samples at sampling rate r, with the Hann window w and X_k = Σ_n w_n x_n exp(-2πi kn/N), the band
power is

    P = 2 / (N Σ w²) · Σ_k W_k |X_k|².

The weight W_k is the fraction of the frequency interval (k ± 1/2) r / N of bin k, clipped to the range 0 to r/2, that
lies in the band. A sine of amplitude A well inside the band has P = A²/2 (Parseval). White noise of variance σ² has the
mean power σ² · (high - low) / (r/2), even if the edges of the band fall between bins. The mean of each window is
subtracted, which does not affect bins from k = 2 on. The relations for sine and noise are therefore exact for low ≥ 1.5
/ window.

The band power P is a quadratic form xᵀAx of the samples. For white noise, the mean of P is σ² tr A and the variance 2
σ⁴ tr A². The distribution of P is nearly that of mean · χ²_ν / ν, with ν = (tr A)² / tr A² degrees of freedom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import gammainc, gammaincinv

from jeit.acoustic.signal.faults import intensity_faults, sample_faults, window_faults
from jeit.acoustic.signal.recording import Intensities, Recording, Taps
from jeit.arguments import check_kind
from jeit_solvers.module import Module

# Minimum number of frequency bins in the frequency band.
_MIN_BAND_BINS = 4.0
# Number of samples Fourier-transformed at a time: 2 MiB, so that samples and transforms fit into the processor's cache.
_MAX_CHUNK_SAMPLES = 2**18


class WindowGrid(NamedTuple):
    """Windows and frequency band of a recording, in samples and frequency bins.

    **Fields**: `length`, `hop`: length of a window and distance between windows, in samples; `taper`: Hann window (N,);
    `first`: index of the first bin in the band; `weights`: 2 W_k / (N Σ w²) of the bins in the band (K,).
    """

    length: int
    hop: int
    taper: np.ndarray
    first: int
    weights: np.ndarray


def window_grid(settings, rate: float, num_samples: int | None, name: str) -> WindowGrid:
    """Convert `IntensitySettings` to windows in samples and frequency bins, at the sampling rate `rate` in Hz.

    `num_samples`: number of samples of the recording, if known; `name`: name of the recording in messages. Raises
    `ValueError` if band, window, rate and number of samples are not compatible.
    """
    window_length, hop_length = round(settings.window * rate), max(1, round(settings.hop * rate))
    if settings.high > rate / 2:
        raise ValueError(
            f"{name}: the band {settings.low:g} to {settings.high:g} Hz reaches beyond half the rate of {rate:g} Hz; "
            f"set high to {rate / 2:g} Hz or less."
        )
    num_band_bins = (settings.high - settings.low) * window_length / rate
    if num_band_bins < _MIN_BAND_BINS:
        raise ValueError(
            f"{name}: a window of {settings.window:g} s resolves frequencies {1 / settings.window:.3g} Hz apart: too "
            f"few in the band {settings.low:g} to {settings.high:g} Hz. Set window to "
            f"{_MIN_BAND_BINS / (settings.high - settings.low):.2g} s or more, or widen the band."
        )
    if num_samples is not None and num_samples < window_length:
        raise ValueError(
            f"{name}: {num_samples} samples at {rate:g} Hz last {num_samples / rate:.3g} s, less than one window of "
            f"{settings.window:g} s. Record longer, or shorten window=."
        )
    # The periodic Hann window is used instead of the symmetric window, since its transform is nonzero in three bins
    # only.
    window_taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(window_length) / window_length)
    bin_edges = np.clip((np.arange(window_length // 2 + 2) - 0.5) * rate / window_length, 0, rate / 2)
    clipped_edges = np.clip(bin_edges, settings.low, settings.high)
    bin_weights = np.diff(clipped_edges) * window_length / rate
    (bin_indices,) = np.nonzero(bin_weights)
    bin_weights = bin_weights[bin_indices[0] : bin_indices[-1] + 1] * 2 / (window_length * (window_taper**2).sum())
    return WindowGrid(window_length, hop_length, window_taper, int(bin_indices[0]), bin_weights)


def band_power(samples: np.ndarray, grid: WindowGrid) -> np.ndarray:
    """Band power (F, M) of the samples (M, S) of M microphones in F windows."""
    is_finite_sample = np.isfinite(samples)
    if not is_finite_sample.all():
        # The substituted values do not matter, since windows with samples that are not finite are marked as not usable.
        samples = np.where(is_finite_sample, samples, 0)
    # A large constant offset of the samples would cost precision. The remaining mean of each window is removed below.
    samples = samples - samples.mean(axis=1, keepdims=True, dtype=float)
    sample_windows = sliding_window_view(samples, grid.length, axis=-1)[:, :: grid.hop]
    num_microphones, num_windows = sample_windows.shape[:2]
    power = np.empty((num_windows, num_microphones))
    last_bin = grid.first + len(grid.weights)
    chunk_size = max(1, _MAX_CHUNK_SAMPLES // (num_microphones * grid.length))
    taper_spectrum = np.fft.rfft(grid.taper)[grid.first : last_bin]
    tapered_buffer = np.empty(num_microphones * min(chunk_size, num_windows) * grid.length)
    for first_window in range(0, num_windows, chunk_size):
        window_chunk = sample_windows[:, first_window : first_window + chunk_size]
        tapered_windows = np.multiply(
            window_chunk, grid.taper, out=tapered_buffer[: window_chunk.size].reshape(window_chunk.shape)
        )
        window_spectra = np.asarray(scipy.fft.rfft(tapered_windows, workers=2))[..., grid.first : last_bin]
        if grid.first < 2:
            # In bins from 2 on, the transform of the Hann window is zero, and the mean of the window has no effect.
            window_spectra = window_spectra - window_chunk.mean(axis=-1)[..., None] * taper_spectrum
        power[first_window : first_window + chunk_size] = (
            (np.real(window_spectra) ** 2 + np.imag(window_spectra) ** 2) @ grid.weights
        ).T
    return power


def _overlap_trace(window_layout: WindowGrid, lag_in_samples: int) -> float:
    """Compute tr(A_0 A_lag) for the band-power matrices A of two windows `lag_in_samples` samples apart. The trace is
    half the covariance of the powers in the two windows for white noise of variance 1.

    With g(d) = Σ_k W_k cos(2πkd/N), which has the period N, A_nm = w_n w_m g(n - m). The trace is therefore Σ_d g(d)²
    r(d), where r is the autocorrelation of u_n = w_n w_(n+lag) over the overlap of the windows. No N × N matrix has to
    be formed.
    """
    spectral_weights = np.zeros(window_layout.length // 2 + 1)
    spectral_weights[window_layout.first : window_layout.first + len(window_layout.weights)] = window_layout.weights
    # The inverse real transform counts all bins twice except the first and, for even N, the last.
    spectral_weights[1 : (window_layout.length + 1) // 2] /= 2
    squared_kernel = (window_layout.length * np.fft.irfft(spectral_weights, window_layout.length)) ** 2
    taper_product = np.zeros(window_layout.length)
    taper_product[: window_layout.length - lag_in_samples] = (
        window_layout.taper[: window_layout.length - lag_in_samples] * window_layout.taper[lag_in_samples:]
    )
    taper_correlation = np.fft.irfft(np.abs(np.fft.rfft(taper_product)) ** 2, window_layout.length)
    return float((squared_kernel * taper_correlation).sum())


def white_noise_degrees_of_freedom(grid: WindowGrid) -> float:
    """Degrees of freedom ν of the band power of white noise in one window. The value is exact, except that the
    subtraction of the window's mean in bins 0 and 1 is neglected."""
    # tr A = Σ w² Σ W, where the weights W include the factor 2 / (N Σ w²).
    return float(((grid.taper**2).sum() * grid.weights.sum()) ** 2 / _overlap_trace(grid, 0))


def noise_correlation(grid: WindowGrid, num_windows: int) -> Float[np.ndarray, "F F"]:
    """Correlation (F, F) between the band powers of white noise in F = `num_windows` overlapping windows."""
    overlapping_lags = range(min(num_windows, -(-grid.length // grid.hop)))
    lag_traces = np.zeros(num_windows)
    lag_traces[: len(overlapping_lags)] = [_overlap_trace(grid, j * grid.hop) for j in overlapping_lags]
    window_lags = np.abs(np.arange(num_windows)[:, None] - np.arange(num_windows))
    return lag_traces[window_lags] / lag_traces[0]


# A tap is audible in a window if the loudness of the window is at least this fraction of the tap's maximum loudness.
_MIN_RELATIVE_TAP_LOUDNESS = 0.5


class IntensitySettings(Module):
    """Frequency band and windows in which intensities are computed.

    **Fields**: `low`, `high`: limits of the band in Hz; `window`: length of a window in seconds; `hop`: time between
    the starts of successive windows in seconds.

    The sound of touches on a soft skin is below 1 kHz. Below 50 Hz, motion of the skin and of the arm that wears it
    dominates. Raises `ValueError` for an invalid frequency band, and for times that are invalid or probably not in
    seconds.

    **Example:**

    ```python
    settings = IntensitySettings(low=100, high=800, window=0.04, hop=0.01)
    measured = intensities(recording, settings)
    ```
    """

    low: float = 50.0
    high: float = 1000.0
    window: float = 0.05
    hop: float = 0.0125

    def __check_init__(self):
        for setting_name in ("low", "high", "window", "hop"):
            setting_value = getattr(self, setting_name)
            if (
                isinstance(setting_value, bool)
                or not isinstance(setting_value, (int, float, np.number))
                or not np.isfinite(setting_value)
            ):
                raise ValueError(f"{setting_name} must be a finite number; it is {setting_value!r}.")
        if not 0 <= self.low < self.high:
            raise ValueError(
                f"low= and high= must be a band in Hz, 0 ≤ low < high; they are {self.low} and {self.high}."
            )
        for setting_name in ("window", "hop"):
            if not getattr(self, setting_name) > 0:
                raise ValueError(f"{setting_name} must be positive, in seconds; it is {getattr(self, setting_name)}.")
        if self.hop > self.window:
            raise ValueError(
                f"hop must be no longer than a window, or sound between windows is lost; they are {self.hop} and "
                f"{self.window} s."
            )
        if self.window > 10:
            raise ValueError(f"window is {self.window} s, longer than any touch; give seconds (0.05, not 50 ms).")


def check_settings(name: str, settings: IntensitySettings | None) -> None:
    """Raises `ValueError` if `settings` is neither an `IntensitySettings` nor None; `name` is the argument's name in
    the message."""
    if settings is not None:
        check_kind(name, settings, IntensitySettings, "IntensitySettings, such as IntensitySettings(window=0.05)")


class TapIntensities(NamedTuple):
    """Intensities of T taps at M microphones, as returned by `tap_intensities`.

    - `power`: (T, M) mean band power in the windows in which the tap is audible, minus the noise floor. Values may be
      negative.
    - `floor`: (M,) noise power that was subtracted.
    - `freedom`: (T,) degrees of freedom ν of the mean band power: for noise alone, the variance of the mean is 2 floor²
      / ν.
    - `usable`: (T, M) mask of the usable values of `power`.
    - `faults`: description of the fault of each of the M channels; "" for no fault.
    """

    power: Float[np.ndarray, "T M"]
    floor: Float[np.ndarray, " M"]
    freedom: Float[np.ndarray, " T"]
    usable: Bool[np.ndarray, "T M"]
    faults: tuple[str, ...]


def intensities(
    recording: Recording, settings: IntensitySettings | None = None, floor: Float[np.ndarray, " M"] | None = None
) -> Intensities:
    """Compute the intensities (band powers) of a recording in sliding windows. Windows with faulty samples are marked
    as not usable.

    **Arguments:**

    - `recording`: samples of the microphones.
    - `settings`: band and windows, by default `IntensitySettings()`.
    - `floor`: noise floor (M,) in the squared unit of the samples. By default the floor is estimated from the quietest
      windows, which requires that at least a fifth of all windows contain no touch. If touches never pause, give the
      floor measured in silence.

    Raises `ValueError` if band, window and recording are not compatible.

    **Example:**

    ```python
    measured = intensities(recording)
    print(measured.power.max(axis=0))
    ```
    """
    check_kind("recording", recording, Recording, "a Recording of samples, as of read_recording(path)")
    check_settings("settings", settings)
    samples, rate = recording.samples, recording.rate
    window_layout = window_grid(settings or IntensitySettings(), rate, samples.shape[-1], recording.name)
    fault_results = [
        window_faults(
            *sample_faults(channel_samples, rate, recording.full_scale), window_layout.length, window_layout.hop
        )
        for channel_samples in samples
    ]
    is_usable_window = np.stack([usable_windows for usable_windows, _ in fault_results], axis=1)
    power = band_power(samples, window_layout)
    degrees_of_freedom = white_noise_degrees_of_freedom(window_layout)
    subtracted_floor = (
        noise_floor(power, is_usable_window, degrees_of_freedom)
        if floor is None
        else _check_floor(floor, samples.shape[0])
    )
    window_times = (window_layout.hop * np.arange(len(power)) + window_layout.length / 2) / rate
    fault_texts = tuple(fault_text for _, fault_text in fault_results)
    return Intensities(
        window_times,
        power - subtracted_floor,
        floor=subtracted_floor,
        freedom=degrees_of_freedom,
        overlap=window_layout.length / window_layout.hop,
        usable=is_usable_window,
        faults=fault_texts,
        name=recording.name,
    )


def tap_intensities(taps: Taps, settings: IntensitySettings | None = None) -> TapIntensities:
    """Compute the intensity of each tap at each microphone, for calibration.

    The power of a tap is the mean over the windows in which the tap is audible, the same windows for all microphones.
    The loudness of a window is the sum over microphones of (power − floor) / floor; the tap is audible where the
    loudness is at least half its maximum. A microphone with a fault in one of the audible windows is not usable for the
    tap, since other windows have a different loudness. The noise floor is estimated from the quietest windows of all
    taps, so the recordings should include some silence before or after the taps. The field `freedom` of the
    result accounts for the overlap of windows (exactly for white noise), but not for the selection of windows. If a tap
    is not audible at all, the loudest windows of noise are selected, and the power of the tap is somewhat too high.

    **Arguments:**

    - `taps`: the taps. If the taps contain intensities instead of samples, the intensities are returned unchanged, with
      a floor of zero and infinite `freedom`.
    - `settings`: band and windows, by default `IntensitySettings()`.

    Raises `ValueError` if `taps` is not a `Taps`, and if band, window and samples are not compatible.

    **Example:**

    ```python
    measured = tap_intensities(taps)
    print(measured.power.shape)  # (T, M)
    ```
    """
    check_kind("taps", taps, Taps, "Taps, as of read_taps(path)")
    check_settings("settings", settings)
    if taps.samples is None or taps.rate is None:
        assert taps.power is not None
        is_usable_window, fault_texts = intensity_faults(taps.power)
        num_taps, num_microphones = taps.power.shape
        return TapIntensities(
            taps.power, np.zeros(num_microphones), np.full(num_taps, np.inf), is_usable_window, fault_texts
        )
    samples, rate = taps.samples, taps.rate
    window_layout = window_grid(settings or IntensitySettings(), rate, samples.shape[-1], taps.name)
    usable_masks, fault_texts = [], []
    for m in range(samples.shape[1]):
        # All taps of a microphone are tested for faults together, since range, converter step and silence are
        # properties of the channel.
        fault_codes, dead_reason = sample_faults(samples[:, m].ravel(), rate, taps.full_scale)
        window_mask, fault_text = window_faults(
            fault_codes.reshape(-1, samples.shape[-1]), dead_reason, window_layout.length, window_layout.hop
        )
        usable_masks.append(window_mask)
        fault_texts.append(fault_text)
    is_usable_window = np.stack(usable_masks, axis=-1)
    power = np.stack([band_power(tap_samples, window_layout) for tap_samples in samples])
    num_taps, num_windows, num_microphones = power.shape
    degrees_of_freedom = white_noise_degrees_of_freedom(window_layout)
    estimated_floor = noise_floor(
        power.reshape(-1, num_microphones), is_usable_window.reshape(-1, num_microphones), degrees_of_freedom
    )
    # A minimum noise floor prevents a simulated channel without noise from dominating the loudness. Dead channels are
    # ignored.
    is_living_microphone = is_usable_window.any(axis=(0, 1))
    positive_floor = np.maximum(estimated_floor, max(1e-9 * power.max(), np.finfo(float).tiny))
    window_loudness = np.where(is_living_microphone, power / positive_floor - estimated_floor / positive_floor, 0).sum(
        axis=-1
    )
    is_audible_window = window_loudness >= _MIN_RELATIVE_TAP_LOUDNESS * window_loudness.max(axis=1, keepdims=True)
    # The loudest window of a tap is always included, even if no window is above the noise floor.
    is_audible_window |= window_loudness == window_loudness.max(axis=1, keepdims=True)
    mean_power = np.einsum("tf,tfm->tm", is_audible_window, power) / is_audible_window.sum(axis=1)[:, None]
    window_correlation = noise_correlation(window_layout, num_windows)
    tap_freedom = np.array(
        [
            degrees_of_freedom * window_mask.sum() ** 2 / window_correlation[np.ix_(window_mask, window_mask)].sum()
            for window_mask in is_audible_window
        ]
    )
    is_usable_tap = (is_usable_window | ~is_audible_window[..., None]).all(axis=1)
    return TapIntensities(mean_power - estimated_floor, estimated_floor, tap_freedom, is_usable_tap, tuple(fault_texts))


def noise_floor(
    power: Float[np.ndarray, "F M"], usable: Bool[np.ndarray, "F M"], degrees_of_freedom: float, share: float = 0.2
) -> Float[np.ndarray, " M"]:
    """Estimate the noise floor (M,), the mean band power of the noise, from F windows of which some contain touches.

    `share`: minimum fraction of the windows that are free of touches. `degrees_of_freedom`: degrees of freedom ν of the
    power of noise. The initial estimate is a low quantile of the powers divided by the same quantile of χ²_ν / ν, as in
    minimum statistics (R. Martin, IEEE Trans. Speech Audio Process. 9, 504-512, 2001). The initial estimate is too high
    by up to a few tenths of the floor if most windows are loud, since the actual fraction of quiet windows is unknown.
    The floor is refined iteratively: the new floor is the mean of the powers below c times the floor, divided by the
    mean of χ²_ν / ν truncated at c. If ν is infinite, the low quantile itself is returned. The floor of a channel
    without usable windows is 0.

    If the noise is not white, its power varies more than ν indicates, and the noise floor is underestimated: by 8 % for
    a spectrum 1/f from 50 to 1000 Hz, and by a third for 1/f².

    Raises `ValueError` for shapes that disagree, usable windows whose power is not finite, and a `share` or
    `degrees_of_freedom` out of range.
    """
    power, usable = np.asarray(power, float), np.asarray(usable)
    if power.ndim != 2 or usable.shape != power.shape or usable.dtype != bool:
        raise ValueError(
            f"power and usable must both be (windows, microphones), usable of booleans; they are {power.shape} and "
            f"{usable.shape} of {usable.dtype}."
        )
    if not 0 < share <= 1:
        raise ValueError(f"share must be a part of the windows, above 0 and up to 1; it is {share!r}.")
    if not degrees_of_freedom > 0:
        raise ValueError(f"freedom must be positive; it is {degrees_of_freedom!r}.")
    if not (np.isfinite(power) | ~usable).all():
        raise ValueError("power is NaN or infinite in windows that usable calls usable; mark those False.")
    num_usable = usable.sum(axis=0)
    sorted_power = np.sort(np.where(usable, power, np.inf), axis=0)
    # Rank of the median power of the quietest `share` of the windows.
    floor_rank = np.clip(np.floor(0.5 * share * num_usable).astype(int), 0, max(len(power) - 1, 0))
    estimated_floor = (
        np.take_along_axis(sorted_power, floor_rank[None], axis=0)[0] if len(power) else np.zeros(power.shape[1])
    )
    estimated_floor = np.where(num_usable > 0, estimated_floor, 0.0)
    if np.isinf(degrees_of_freedom):
        return estimated_floor
    half_degrees_of_freedom = degrees_of_freedom / 2
    # Quantiles of χ²_ν / ν, and the mean of χ²_ν / ν below the cut-off c: ∫_0^c y p(y) dy is the distribution function
    # of χ² with ν + 2 degrees of freedom, at ν c.
    estimated_floor = estimated_floor / (gammaincinv(half_degrees_of_freedom, 0.5 * share) / half_degrees_of_freedom)
    quiet_cutoff = gammaincinv(half_degrees_of_freedom, 0.9) / half_degrees_of_freedom
    mean_below_cutoff = gammainc(half_degrees_of_freedom + 1, half_degrees_of_freedom * quiet_cutoff) / 0.9
    for _ in range(50):
        is_quiet_window = usable & (power <= quiet_cutoff * estimated_floor)
        quiet_mean = (
            np.where(is_quiet_window, power, 0).sum(axis=0)
            / np.maximum(is_quiet_window.sum(axis=0), 1)
            / mean_below_cutoff
        )
        updated_floor = np.where(is_quiet_window.any(axis=0), quiet_mean, estimated_floor)
        if np.allclose(updated_floor, estimated_floor, rtol=1e-6, atol=0):
            break
        estimated_floor = updated_floor
    return estimated_floor


def degrees_of_freedom(settings: IntensitySettings, rate: float) -> float:
    """Degrees of freedom ν of the band power of white noise in one window, sampled at `rate` Hz. The variance of the
    power is 2 mean² / ν."""
    return white_noise_degrees_of_freedom(window_grid(settings, rate, None, "settings"))


def _check_floor(floor, num_microphones: int) -> Float[np.ndarray, " M"]:
    floor_values = np.asarray(floor)
    if (
        floor_values.dtype.kind not in "fiu"
        or floor_values.shape != (num_microphones,)
        or not (np.isfinite(floor_values) & (floor_values >= 0)).all()
    ):
        raise ValueError(
            f"floor must be finite and not negative, one for each of the {num_microphones} microphones; it is "
            f"{floor_values.dtype} of shape {floor_values.shape}."
        )
    return floor_values.astype(float)
