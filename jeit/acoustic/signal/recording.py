"""Recordings of microphones, and the files from which recordings are read.

All input is validated here: types, shapes, and plausible values in metres and hertz. Later steps do not check the input
again. The signals of a broken microphone (NaN, zeros, clipped peaks) are accepted here; `jeit.acoustic.signal.faults`
detects such faults.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.acoustic.signal._arrays import (
    alternative_array_name,
    check_coordinates,
    check_extent,
    check_full_scale,
    check_microphones,
    check_taps,
    convert_to_real_array,
    real_number,
    sampling_rate,
    short_text,
)
from jeit.acoustic.signal.faults import intensity_faults
from jeit.acoustic.signal.sound_file import read_sound
from jeit.files import atomically_written_file, npz_arrays, require_arrays
from jeit.mesh.topology import check_loop
from jeit_solvers.module import Module

# Error message for files of an unknown format.
_UNKNOWN_FORMAT = "neither an NPZ nor a sound file"
# Maximum magnitude of a sample in any unit; squares of larger samples would overflow in single precision.
_MAX_SAMPLE_MAGNITUDE = 1e15


class Recording(Module):
    """Simultaneous sound samples of M microphones.

    **Arguments:**

    - `samples`: S samples of each microphone (M, S) in any unit (volts, counts, fractions of full scale). NaN and
      infinite samples are stored unchanged; magnitudes above 1e15 are replaced by infinity.
    - `rate`: sampling rate of each microphone, Hz.
    - `full_scale`: largest magnitude of a sample that the device can return, or None if unknown.
    - `name`: name of the recording, used in messages.

    **Example:**

    ```python
    recorded = Recording(np.random.default_rng(0).normal(size=(16, 8000)), rate=4000)
    measured = intensities(recorded)
    ```
    """

    samples: Float[np.ndarray, "M S"]
    rate: float
    full_scale: float | None
    name: str = eqx.field(static=True)

    def __init__(
        self, samples: ArrayLike, rate: ArrayLike, *, full_scale: ArrayLike | None = None, name: str = "recording"
    ):
        """Raises `ValueError` for samples that are not real, have a shape other than (M, S) or look transposed, and for
        an implausible sampling rate."""
        sample_array = convert_to_real_array(samples, "samples", "microphones, samples")
        is_too_large = (
            np.abs(sample_array) > _MAX_SAMPLE_MAGNITUDE if sample_array.dtype.kind == "f" else np.zeros(0, bool)
        )
        self.samples = np.where(is_too_large, np.inf, sample_array) if is_too_large.any() else sample_array
        num_microphones, num_samples = self.samples.shape
        if num_microphones > num_samples:
            raise ValueError(
                f"samples has shape {self.samples.shape}: {num_microphones} microphones with {num_samples} samples "
                "each. It looks transposed: give (microphones, samples)."
            )
        self.rate, self.full_scale, self.name = sampling_rate(rate), check_full_scale(full_scale), name


class Intensities(Module):
    """Band power of M microphones in F time windows.

    **Arguments:**

    - `times`: middle (F,) of each window, seconds.
    - `power`: band power (F, M) minus the noise floor, in the squared unit of the samples. Values may be negative, and
      are NaN only where a window is not usable.
    - `floor`: noise power (M,) that was subtracted from the band power; zero if unknown.
    - `freedom`: degrees of freedom ν of the power of white noise in a window: the variance of the power is 2 floor² /
      ν. Infinite if unknown.
    - `overlap`: length of a window divided by the hop between windows; 1 if windows do not overlap.
    - `usable`: mask (F, M) of the windows without a fault; by default where `power` is finite.
    - `faults`: description of the fault of each of the M channels; "" for no fault.
    - `name`: name of the recording, used in messages.
    - `notes`: remarks on the measurement, as texts.

    **Example:**

    ```python
    measured = Intensities(times=[0.0, 0.1], power=np.ones((2, 16)))
    locations = locate(measured, calibration)
    ```
    """

    times: Float[np.ndarray, " F"]
    power: Float[np.ndarray, "F M"]
    floor: Float[np.ndarray, " M"]
    freedom: float
    overlap: float
    usable: Bool[np.ndarray, "F M"]
    faults: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        times: ArrayLike,
        power: ArrayLike,
        *,
        floor: ArrayLike | None = None,
        freedom: ArrayLike = np.inf,
        overlap: ArrayLike = 1.0,
        usable: ArrayLike | None = None,
        faults: Sequence[str] | np.ndarray | None = None,
        name: str = "intensities",
        notes: Sequence[str] | np.ndarray = (),
    ):
        """By default, `usable` and `faults` are derived from NaN, infinite values and dead channels in `power`.

        Raises `ValueError` for values that are not real or out of range, for shapes that disagree, and for times that
        do not increase.
        """
        self.times, self.power = (
            convert_to_real_array(times, "times", "windows"),
            convert_to_real_array(power, "intensity", "windows, microphones"),
        )
        power_shape, num_windows = self.power.shape, len(self.times)
        if power_shape[0] != num_windows:
            shape_hint = " It looks transposed: give (windows, microphones)." if power_shape[1] == num_windows else ""
            raise ValueError(
                f"intensity has shape {power_shape}, but there are {num_windows} times, one a window.{shape_hint}"
            )
        if not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
            raise ValueError("times must be finite and increasing, in seconds: the middle of each window.")
        self.floor = np.zeros(power_shape[1]) if floor is None else convert_to_real_array(floor, "floor", "microphones")
        if self.floor.shape != power_shape[1:] or not (np.isfinite(self.floor) & (self.floor >= 0)).all():
            raise ValueError(
                f"floor must be finite and not negative, one for each of the {power_shape[1]} microphones; it is "
                f"{short_text(self.floor)}. Leave it out when it is not known."
            )
        self.freedom = real_number(freedom, "freedom")
        if not self.freedom > 0:
            raise ValueError(f"freedom must be positive (infinite when unknown); it is {self.freedom}.")
        self.overlap = real_number(overlap, "overlap")
        if not 1 <= self.overlap <= max(num_windows, 1):
            raise ValueError(
                f"overlap must be at least 1 and no more than the {num_windows} windows: how many of them share a "
                f"sample (window / hop); it is {self.overlap:g}."
            )
        default_usable, default_faults = intensity_faults(self.power)
        usable_mask = default_usable if usable is None else np.asarray(usable)
        self.faults = default_faults if faults is None else tuple(str(fault_text) for fault_text in faults)
        if usable_mask.shape != power_shape or usable_mask.dtype != bool or len(self.faults) != power_shape[1]:
            raise ValueError(
                f"usable is {usable_mask.dtype} of shape {usable_mask.shape} with {len(self.faults)} faults; give "
                f"booleans of shape {power_shape}, and one string a microphone."
            )
        self.usable, self.name, self.notes = usable_mask & np.isfinite(self.power), name, tuple(notes)


class Taps(Module):
    """T taps at known positions in d = 2 or 3 dimensions, for the calibration of M microphones, with either `power`, or
    `samples` and `rate`.

    **Arguments:**

    - `microphones`: positions (M, d) of the microphones, metres.
    - `outline`: vertices (K, d) of the skin's outline in order, metres. A plane outline is ordered counter-clockwise.
    - `positions`: positions (T, d) of the taps, metres.
    - `power`: intensity (T, M) of each tap above the noise floor.
    - `samples`: S samples of each tap at each microphone (T, M, S).
    - `rate`: sampling rate of the samples, Hz.
    - `full_scale`, `name`: as in `Recording`.

    **Example:**

    ```python
    taps = Taps(skin.microphones, outline, tapped.positions, samples=tapped.samples, rate=tapped.rate)
    fit = calibrate_microphones(taps, decay="inverse-square")
    ```
    """

    microphones: Float[np.ndarray, "M d"]
    outline: Float[np.ndarray, "K d"]
    positions: Float[np.ndarray, "T d"]
    power: Float[np.ndarray, "T M"] | None
    samples: Float[np.ndarray, "T M S"] | None
    rate: float | None
    full_scale: float | None
    name: str = eqx.field(static=True)

    def __init__(
        self,
        microphones: ArrayLike,
        outline: ArrayLike,
        positions: ArrayLike,
        *,
        power: ArrayLike | None = None,
        samples: ArrayLike | None = None,
        rate: ArrayLike | None = None,
        full_scale: ArrayLike | None = None,
        name: str = "taps",
    ):
        """Either `power` or `samples` and `rate` must be given.

        Raises `ValueError` for invalid arrays, for microphones farther from the skin than its length, for two
        microphones at the same position, and, on a plane skin, for taps farther outside the outline than 5 % of the
        skin's length.
        """
        self.outline = check_coordinates(outline, "outline", np.shape(microphones)[-1:])
        self.microphones = check_coordinates(microphones, "microphones", self.outline.shape[1:])
        self.positions = check_coordinates(positions, "positions", self.outline.shape[1:])
        if self.outline.shape[1] == 2:
            self.outline = check_loop(self.outline, "outline", clockwise=False)
        elif len(self.outline) < 3:
            raise ValueError(f"outline: expected at least three vertices, got {len(self.outline)}.")
        for array_label, array_points in (
            ("outline", self.outline),
            ("microphones", self.microphones),
            ("positions", self.positions),
        ):
            check_extent(np.concatenate([self.outline, array_points]), array_label)
        is_plane_outline = self.outline.shape[1] == 2
        check_microphones(
            self.microphones, self.outline if is_plane_outline else np.vstack([self.outline, self.positions])
        )
        if is_plane_outline:
            check_taps(self.positions, self.outline)
        if (power is None) == (samples is None):
            given_arrays = "neither" if power is None else "both"
            raise ValueError(f"taps need either intensity or samples with their rate; {given_arrays} were given.")
        expected_shape = (len(self.positions), len(self.microphones))
        self.power = None if power is None else convert_to_real_array(power, "intensity", "taps, microphones")
        self.samples = (
            None if samples is None else convert_to_real_array(samples, "samples", "taps, microphones, samples")
        )
        array_label, tap_array = ("intensity", self.power) if self.samples is None else ("samples", self.samples)
        assert tap_array is not None
        if tap_array.shape[:2] != expected_shape:
            looks_transposed = tap_array.shape == expected_shape[::-1] or (
                tap_array.ndim == 3 and tap_array.shape[::2] == expected_shape
            )
            shape_hint = " It looks transposed." if looks_transposed else ""
            raise ValueError(
                f"{array_label} has shape {tap_array.shape}, but there are {expected_shape[0]} positions and "
                f"{expected_shape[1]} microphones: give (taps, "
                f"microphones{', samples' if tap_array.ndim == 3 else ''}).{shape_hint}"
            )
        if self.samples is not None and rate is None:
            raise ValueError("rate is missing: samples need the samples a second of each microphone, in Hz.")
        self.rate = None if self.samples is None else sampling_rate(rate)
        self.full_scale, self.name = check_full_scale(full_scale), name


def read_recording(path: str | Path) -> Recording | Intensities:
    """Read a recording from a WAV file with any number of channels, from an NPZ file, or, if `soundfile` is installed,
    from a sound file of a different format (FLAC, Ogg, AIFF, …).

    An NPZ file contains either `samples` (M, S), `rate` in Hz and optionally `full_scale`; or `intensity` (F, M),
    `times` (F,) in seconds and optionally `floor` (M,), `freedom` and `overlap`, as in `Intensities`. Integer samples
    of a sound file are converted to fractions of full scale, from -1 to 1.

    **Arguments:**

    - `path`: path of the file.

    Raises `ValueError` for a file with other content, and `OSError` if the file cannot be opened.

    **Example:**

    ```python
    write_recording("recording.npz", recording)
    same = read_recording("recording.npz")
    ```
    """
    path = Path(path)
    try:
        sound_data = read_sound(path)
        if sound_data is not None:
            samples, rate, full_scale = sound_data
            return Recording(samples, rate, full_scale=full_scale, name=path.stem)
        optional_names = ("floor", "freedom", "overlap")
        stored_arrays = npz_arrays(
            path, "samples", "rate", "full_scale", "intensity", "times", *optional_names, otherwise=_UNKNOWN_FORMAT
        )
        array_name = alternative_array_name(stored_arrays, "intensity", "samples")
        if array_name == "samples":
            if stored_arrays["samples"].ndim == 3:
                raise ValueError("samples has three axes, as a file of taps has: read that with read_taps.")
            require_arrays(stored_arrays, "rate")
            return Recording(
                stored_arrays["samples"],
                stored_arrays["rate"],
                full_scale=stored_arrays.get("full_scale"),
                name=path.stem,
            )
        require_arrays(stored_arrays, "times")
        optional_arrays = {
            optional_name: stored_arrays[optional_name]
            for optional_name in optional_names
            if optional_name in stored_arrays
        }
        return Intensities(stored_arrays["times"], stored_arrays["intensity"], **optional_arrays, name=path.stem)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def read_taps(path: str | Path) -> Taps:
    """Read calibration taps from an NPZ file.

    The file contains `microphones` (M, d), `outline` (K, d) and `positions` (T, d) in metres; either `intensity` (T, M)
    or `samples` (T, M, S) and `rate` in Hz; and optionally `full_scale`.

    **Arguments:**

    - `path`: path of the file.

    Raises `ValueError` for a file with other content, and `OSError` if the file cannot be opened.

    **Example:**

    ```python
    write_taps("taps.npz", taps)
    same = read_taps("taps.npz")
    ```
    """
    path = Path(path)
    geometry_names = ("microphones", "outline", "positions")
    try:
        array_names = (*geometry_names, "intensity", "samples", "rate", "full_scale")
        stored_arrays = npz_arrays(path, *array_names, otherwise=_UNKNOWN_FORMAT)
        require_arrays(stored_arrays, *geometry_names)
        array_name = alternative_array_name(stored_arrays, "intensity", "samples")
        tap_arguments = {"power" if array_name == "intensity" else "samples": stored_arrays[array_name]}
        if array_name == "samples":
            require_arrays(stored_arrays, "rate")
            tap_arguments |= {"rate": stored_arrays["rate"]}
        full_scale = stored_arrays.get("full_scale")
        return Taps(
            *(stored_arrays[geometry_name] for geometry_name in geometry_names),
            **tap_arguments,
            full_scale=full_scale,
            name=path.stem,
        )
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def write_recording(path: str | Path, recording: Recording | Intensities) -> None:
    """Write a recording to an NPZ file for `read_recording`. Intensities that are not usable are written as NaN.

    **Arguments:**

    - `path`: path of the file.
    - `recording`: samples or intensities.

    **Example:**

    ```python
    write_recording("recording.npz", recording)
    same = read_recording("recording.npz")
    ```
    """
    if isinstance(recording, Recording):
        _write_npz(path, samples=recording.samples, rate=recording.rate, full_scale=recording.full_scale)
    else:
        intensity_fields = {
            field_name: getattr(recording, field_name) for field_name in ("times", "floor", "freedom", "overlap")
        }
        _write_npz(path, intensity=np.where(recording.usable, recording.power, np.nan), **intensity_fields)


def write_taps(path: str | Path, taps: Taps) -> None:
    """Write calibration taps to an NPZ file for `read_taps`.

    **Arguments:**

    - `path`: path of the file.
    - `taps`: the taps.

    **Example:**

    ```python
    write_taps("taps.npz", taps)
    same = read_taps("taps.npz")
    ```
    """
    geometry_arrays = {"microphones": taps.microphones, "outline": taps.outline, "positions": taps.positions}
    _write_npz(
        path, **geometry_arrays, intensity=taps.power, samples=taps.samples, rate=taps.rate, full_scale=taps.full_scale
    )


def _write_npz(path: str | Path, **arrays) -> None:
    with atomically_written_file(path) as npz_file:
        np.savez(
            npz_file,
            allow_pickle=False,
            **{array_name: array_value for array_name, array_value in arrays.items() if array_value is not None},
        )
