"""Series of images over time, and oscillations of their values (such as breathing): spectra, and amplitude and phase at
a frequency.

At a frequency f, the values x are fitted by weighted least squares, with weights w (a window over the measured time),
to

    x(t) ≈ a + b t + A cos(2πf t + φ).

For evenly spaced times and an integer number of periods, the fit equals the discrete Fourier transform at f. For other
times the fit avoids the leakage of the mean, of the drift and of the frequency -f into the result. Frequencies can be
distinguished if they differ by at least the resolution, which is 1 / T without a window and 2 / T with Hann's window,
where T is the measured time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Real
from numpy.typing import ArrayLike

from jeit.arguments import check_name, describe, is_number, object_html, object_text, picture
from jeit.mesh import Mesh, measures


@dataclass(frozen=True)
class ImageSeries:
    """Images of the change of conductivity over time: F frames on a mesh of m cells.

    **Fields**: `mesh`; `changes`: (F, m) change of every cell in every frame, in S/m (2-D: S), NaN in a frame without
    an image; `times`: (F,) increasing times of the frames in seconds; `background`: the conductivity from which the
    changes are measured, in S/m (2-D: S); `timed`: False if `times` are frame numbers instead of seconds.

    Raises `ValueError` if shapes of the fields disagree, if times do not increase, and if no frame has an image.

    **Example:**

    ```python
    series = ImageSeries(mesh, changes, times, background=1.0)
    series.frame_rate, series.mean_change(ball_region(mesh, [0.04, 0.0], 0.02))
    ```
    """

    mesh: Mesh
    changes: Real[np.ndarray, "F m"]
    times: Float[np.ndarray, " F"]
    background: float = float("nan")
    timed: bool = True

    def __post_init__(self):
        changes, times = np.asarray(self.changes), np.asarray(self.times, float)
        if changes.ndim != 2 or changes.shape[1] != self.mesh.num_cells or changes.dtype.kind != "f":
            raise ValueError(
                f"changes are {changes.dtype} of shape {changes.shape}; give (frames, {self.mesh.num_cells}), one "
                "number for each cell."
            )
        if times.shape != changes.shape[:1] or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise ValueError(f"times must be {len(changes)} seconds that rise, one for each frame.")
        object.__setattr__(self, "changes", changes)
        object.__setattr__(self, "times", times)
        if not self.imaged.any():
            raise ValueError("changes: no frame has an image.")

    def __repr__(self) -> str:
        return object_text(
            lambda: f"ImageSeries({len(self.times)} frames, {self.mesh!r})",
            self,
        )

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return object_html(self)

    @property
    def imaged(self) -> Bool[np.ndarray, " F"]:
        """Mask (F,) of the frames that have an image."""
        return np.isfinite(self.changes[:, 0]) & np.isfinite(self.changes[:, -1])

    @property
    def frame_rate(self) -> float | None:
        """Mean frame rate in frames per second; None for a single frame, and if the times of the frames are not
        known."""
        if len(self.times) < 2 or not self.timed:
            return None
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))

    @property
    def titles(self) -> list[str]:
        """Title of each frame: the time of the frame, or the frame number if times are not known."""
        return [f"{time:.2f} s" if self.timed else f"frame {time:.0f}" for time in self.times]

    @property
    def unit(self) -> str:
        """Unit of the changes of conductivity."""
        return "S" if self.mesh.dimension == 2 else "S/m"

    def functional(self) -> Float[np.ndarray, " m"]:
        """Functional image (m,): the standard deviation over time of the change in every cell."""
        return self.changes[self.imaged].std(axis=0, dtype=float)

    def mean_change(self, region: ArrayLike) -> Float[np.ndarray, " F"]:
        """Mean change of conductivity (F,) in a region of the mesh, weighted by cell size; NaN for frames without an
        image.

        `region`: mask (m,) of the cells of the region, for example from `ball_region`, `box_region` or `half_region`.
        Raises `ValueError` for a mask of the wrong shape, and for an empty region.
        """
        is_in_region = np.asarray(region)
        if is_in_region.dtype != bool or is_in_region.shape != (self.mesh.num_cells,) or not is_in_region.any():
            raise ValueError(f"region must be {self.mesh.num_cells} booleans, one a cell, at least one of them True.")
        cell_sizes = np.asarray(measures(self.mesh))[is_in_region]
        return self.changes[:, is_in_region].astype(float) @ (cell_sizes / cell_sizes.sum())


Window = Literal["hann", "none"]
# Frequency resolution of each window in units of 1 / T, where T is the measured time; number of trial frequencies per
# frequency resolution in the search for the strongest frequency.
_WINDOW_RESOLUTION = {"hann": 2.0, "none": 1.0}
_FREQUENCIES_PER_RESOLUTION = 8
# Minimum number of periods of an oscillation in the measured time.
_MIN_MEASURED_PERIODS = 1.0


@dataclass(frozen=True)
class Oscillation:
    """The component of values (frames, …) that oscillates at one frequency, the result of `oscillation`.

    **Fields**

    - `frequency`: frequency of the oscillation in hertz.
    - `amplitude`: (…), in the unit of the values: half of the difference between maximum and minimum.
    - `phase`: (…), radians from -π to π: the values vary as cos(2πf t + phase), where t are the `times` passed to
      `oscillation`. The phase is meaningless where the amplitude is only noise.
    - `noise`: (…), standard deviation of the amplitude, computed from the residual of the fit. The residual includes
      oscillations at other frequencies.
    - `resolution`: hertz, smallest difference of two distinguishable frequencies.

    **Example:**

    ```python
    found = oscillation(changes, times, 1.0)
    found.amplitude, found.phase
    ```
    """

    frequency: float
    amplitude: Float[np.ndarray, "..."]
    phase: Float[np.ndarray, "..."]
    noise: Float[np.ndarray, "..."]
    resolution: float


def oscillation(
    values: ArrayLike, times: ArrayLike, frequency: float | tuple[float, float], *, window: Window = "hann"
) -> Oscillation:
    """Amplitude and phase with which values oscillate over time at one frequency. Frames with NaN are left out.

    **Arguments:**

    - `values` (F, …): values in each of F frames, in any unit.
    - `times` (F,): times of the frames in seconds, which need not be evenly spaced.
    - `frequency`: hertz, or a band (lowest, highest) in which the frequency with the largest power, summed over all
      values, is determined. Frequencies with less than one period in the measured time are not considered.
    - `window`: "hann", Hann's window, which separates different frequencies better; or "none", with which a single
      oscillation is resolved twice as finely.

    Raises `ValueError` for fewer than five frames, less than one period in the measured time, a frequency at or above
    half the frame rate, and invalid options.

    **Example:**

    ```python
    breath = oscillation(changes, times, (0.5, 1.5))
    breath.frequency, breath.amplitude
    ```
    """
    finite_values, finite_times = _frames_without_nan(values, times)
    check_name("window", window, _WINDOW_RESOLUTION)
    measured_duration = float(finite_times[-1] - finite_times[0])
    frequency_resolution = _WINDOW_RESOLUTION[window] / measured_duration
    min_frequency, max_frequency = _frequency_band(frequency)
    frame_rate = (len(finite_times) - 1) / measured_duration
    if max_frequency >= frame_rate / 2:
        raise ValueError(
            f"frequency: {max_frequency:g} Hz is not below half the frame rate of {frame_rate:.4g} Hz, and would be "
            "another."
        )
    if max_frequency * measured_duration < _MIN_MEASURED_PERIODS:
        raise ValueError(
            f"frequency: {max_frequency:g} Hz has no whole period in the {measured_duration:.3g} s measured; measure "
            "longer."
        )
    min_frequency = max(min_frequency, _MIN_MEASURED_PERIODS / measured_duration)
    frame_weights = _window_weights(finite_times, window)
    flat_values = finite_values.reshape(len(finite_values), -1)
    best_frequency = (
        min_frequency
        if min_frequency == max_frequency
        else _strongest_frequency(
            flat_values, finite_times, frame_weights, (min_frequency, max_frequency, frequency_resolution)
        )
    )
    coefficients, residual_variance, coefficient_variances = _fit_sinusoid(
        flat_values, finite_times, frame_weights, best_frequency
    )
    value_shape = finite_values.shape[1:]
    cosine_coefficient, sine_coefficient = coefficients[2], coefficients[3]
    amplitude_noise = np.sqrt(residual_variance) * np.sqrt((coefficient_variances[2] + coefficient_variances[3]) / 2)
    return Oscillation(
        best_frequency,
        np.hypot(cosine_coefficient, sine_coefficient).reshape(value_shape),
        np.arctan2(-sine_coefficient, cosine_coefficient).reshape(value_shape),
        amplitude_noise.reshape(value_shape),
        frequency_resolution,
    )


def amplitude_spectrum(
    values: ArrayLike, times: ArrayLike, *, window: Window = "hann"
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K ..."]]:
    """Amplitude spectrum of values. Returns K frequencies in hertz, from one period in the measured time to half the
    frame rate in steps of half the resolution, and the amplitudes (K, …) in the unit of the values. A sinusoidal
    oscillation appears as a peak as high as its amplitude.

    The mean of the values over time is subtracted first. Frames with NaN are left out.

    **Arguments:**

    - `values`, `times`, `window`: as in `oscillation`.

    Raises `ValueError` as `oscillation` does.

    **Example:**

    ```python
    frequencies, amplitudes = amplitude_spectrum(changes.mean(axis=1), times)
    ```
    """
    finite_values, finite_times = _frames_without_nan(values, times)
    check_name("window", window, _WINDOW_RESOLUTION)
    measured_duration = float(finite_times[-1] - finite_times[0])
    frequencies = np.arange(
        1 / measured_duration,
        (len(finite_times) - 1) / measured_duration / 2,
        _WINDOW_RESOLUTION[window] / measured_duration / 2,
    )
    frame_weights = _window_weights(finite_times, window)
    centred_values = finite_values - np.tensordot(frame_weights, finite_values, 1) / frame_weights.sum()
    weighted_phase_factors = frame_weights * np.exp(
        -2j * np.pi * frequencies[:, None] * (finite_times - finite_times[0])
    )
    return frequencies, 2 * np.abs(np.tensordot(weighted_phase_factors, centred_values, 1)) / frame_weights.sum()


def _frequency_band(frequency) -> tuple[float, float]:
    """The lowest and the highest frequency in hertz, which are equal if `frequency` is a number."""
    frequency_band = (frequency, frequency) if is_number(frequency) else frequency
    if not (
        isinstance(frequency_band, tuple | list)
        and len(frequency_band) == 2
        and all(is_number(band_limit) and band_limit > 0 for band_limit in frequency_band)
    ):
        raise ValueError(f"frequency must be positive hertz, or a band (lowest, highest); it is {describe(frequency)}.")
    if frequency_band[0] > frequency_band[1]:
        raise ValueError(
            f"frequency: the band from {frequency_band[0]:g} to {frequency_band[1]:g} Hz is the wrong way round."
        )
    return float(frequency_band[0]), float(frequency_band[1])


def _frames_without_nan(frame_values, frame_times) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames (rows) without NaN as real numbers, and the times of these frames."""
    value_array, time_array = np.asarray(frame_values), np.asarray(frame_times, float)
    if value_array.ndim < 1 or value_array.dtype.kind not in "iuf" or time_array.shape != value_array.shape[:1]:
        raise ValueError(
            f"values are {value_array.dtype} of shape {value_array.shape}, times {time_array.shape}; give a row for "
            "each time."
        )
    if not np.isfinite(time_array).all() or (np.diff(time_array) <= 0).any():
        raise ValueError("times must be finite and rise, in seconds.")
    is_finite_frame = np.isfinite(value_array.reshape(len(value_array), -1)).all(axis=1)
    if is_finite_frame.sum() < 5:
        raise ValueError(
            f"values: {int(is_finite_frame.sum())} frames without NaN; an oscillation takes five at least."
        )
    return value_array[is_finite_frame].astype(float), time_array[is_finite_frame]


def _window_weights(times: np.ndarray, window: Window) -> np.ndarray:
    """Return the weight of each frame in a window. Hann's window is shifted so that the first and last frames have
    nonzero weights."""
    if window == "none":
        return np.ones(len(times))
    mean_frame_interval = (times[-1] - times[0]) / (len(times) - 1)
    return (
        np.sin(np.pi * (times - times[0] + mean_frame_interval / 2) / (times[-1] - times[0] + mean_frame_interval)) ** 2
    )


def _fit_sinusoid(frame_values: np.ndarray, frame_times: np.ndarray, frame_weights: np.ndarray, frequency: float):
    """Fit mean, drift, cosine and sine to n series. Returns coefficients (4, n), residual variances (n,), and the
    variance of each coefficient (4,) for noise of unit variance."""
    phase_angle = 2 * np.pi * frequency * frame_times
    centred_times = frame_times - frame_times.mean()
    design_matrix = np.stack(
        [np.ones(len(frame_times)), centred_times / centred_times[-1], np.cos(phase_angle), np.sin(phase_angle)], axis=1
    )
    weighted_pseudoinverse = np.linalg.pinv(np.sqrt(frame_weights)[:, None] * design_matrix) * np.sqrt(frame_weights)
    sinusoid_coefficients = weighted_pseudoinverse @ frame_values
    residual_variance = ((frame_values - design_matrix @ sinusoid_coefficients) ** 2).sum(axis=0) / max(
        len(frame_times) - 4, 1
    )
    return sinusoid_coefficients, residual_variance, (weighted_pseudoinverse**2).sum(axis=1)


def _strongest_frequency(
    frame_values: np.ndarray,
    frame_times: np.ndarray,
    frame_weights: np.ndarray,
    searched_band: tuple[float, float, float],
) -> float:
    """Return the frequency in a band (lowest, highest, resolution) at which the power summed over all values is
    largest."""
    min_frequency, max_frequency, frequency_resolution = searched_band
    # The power is computed from the first eight principal components of the values.
    centred_values = frame_values - frame_values.mean(axis=0)
    left_vectors, singular_values, _ = np.linalg.svd(
        centred_values @ centred_values.T if centred_values.shape[1] > len(centred_values) else centred_values,
        full_matrices=False,
    )
    singular_values = np.sqrt(singular_values) if centred_values.shape[1] > len(centred_values) else singular_values
    principal_components = left_vectors[:, :8] * singular_values[:8]

    def negative_power(frequency: float) -> float:
        sinusoid_coefficients, _, _ = _fit_sinusoid(principal_components, frame_times, frame_weights, frequency)
        return -float((sinusoid_coefficients[2:] ** 2).sum())

    trial_frequencies = np.linspace(
        min_frequency,
        max_frequency,
        max(int(np.ceil((max_frequency - min_frequency) / frequency_resolution * _FREQUENCIES_PER_RESOLUTION)), 2) + 1,
    )
    best_index = int(np.argmin([negative_power(frequency) for frequency in trial_frequencies]))
    search_interval = (
        trial_frequencies[max(best_index - 1, 0)],
        trial_frequencies[min(best_index + 1, len(trial_frequencies) - 1)],
    )
    refined_maximum: Any = scipy.optimize.minimize_scalar(
        negative_power, bounds=search_interval, method="bounded", options={"xatol": 1e-9}
    )
    return float(refined_maximum.x)
