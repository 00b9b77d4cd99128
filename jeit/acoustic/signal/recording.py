"""Recordings of microphones, and the files from which they are read.

All input is validated here: types, shapes, metres and hertz. Later steps do not check it again. The signals of a broken
microphone (NaN, zeros, clipped peaks) are accepted here; `jeit.acoustic.signal.faults` detects them.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import scipy.io.wavfile
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.acoustic.signal._arrays import (
    check_coordinates,
    check_extent,
    check_full_scale,
    check_microphones,
    check_taps,
    choose_array,
    real_array_of,
    real_number,
    sampling_rate,
    short_text,
)
from jeit.acoustic.signal.faults import intensity_faults
from jeit.arguments.extras import optional
from jeit.files import check_memory, need, npz_arrays, read_as, reason, written_whole
from jeit.mesh.topology import check_loop
from jeit_solvers.module import Module

# Bytes of memory needed per byte of a file with eight bits per sample.
_IN_MEMORY = 16
# First bytes of the formats read by `soundfile`: FLAC, Ogg, AIFF, CAF, AU, Wave64, VOC, MP3 with a tag.
_SOUNDFILE_STARTS = (b"fLaC", b"OggS", b"FORM", b"caff", b".snd", b"riff", b"Creative", b"ID3")
# Bytes that identify formats which `soundfile` does not read: MP4 (from the fifth byte on); WebM, WMA and AMR.
_MP4, _UNREADABLE_STARTS = b"ftyp", (b"\x1aE\xdf\xa3", b"0&\xb2u", b"#!AMR")


def read_sound(path: Path) -> tuple[np.ndarray, float, float | None] | None:
    """Read the samples (M, S), the sampling rate in Hz and the full scale of a sound file. Returns None if the format
    is unknown.

    Integer samples are converted to fractions of full scale, from -1 to 1. Floats are unchanged; if any exceeds 1, the
    full scale is None (unknown). Raises `ValueError` for broken files, for formats that cannot be read, and if
    `soundfile` is needed but not installed.
    """
    check_memory(path.name, _IN_MEMORY * path.stat().st_size)
    with path.open("rb") as file:
        start = file.read(8)
    if start.startswith((b"RIFF", b"RIFX", b"RF64")):
        return _read_wav(path)
    if start.startswith(_SOUNDFILE_STARTS) or _is_mp3(start):
        return _read_with_soundfile(path)
    if start[4:] == _MP4 or start.startswith(_UNREADABLE_STARTS):
        raise ValueError(
            f"a format that is not read (M4A, MP4, WebM, WMA, AMR); convert it: ffmpeg -i '{path.name}' "
            f"'{path.stem}.wav'."
        )
    return None


def _is_mp3(start: bytes) -> bool:
    """Whether the bytes are the start of an MPEG layer III frame: eleven set bits, any version, and the layer."""
    return len(start) > 1 and start[0] == 0xFF and start[1] & 0xE6 == 0xE2


def _read_wav(path: Path) -> tuple[np.ndarray, float, float | None]:
    problem, rate, data = None, 0, np.zeros(0)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            rate, data = scipy.io.wavfile.read(path)
        except Exception as error:  # damaged files raise exceptions of many types
            problem = error
    # SciPy only warns of a truncated file, or fails later. Its other warnings concern chunks without sound.
    if any("prematurely" in str(one.message) for one in said):
        raise ValueError("the WAV file is cut off: it holds fewer samples than its header says. Copy it again.")
    if "Unknown wave file format" in str(problem):  # A-law or ADPCM, for example
        return _read_with_soundfile(path)
    if problem is not None:
        raise ValueError(f"not a readable WAV file, or cut off ({reason(problem)}); write it as plain PCM or float.")
    samples = data.T if data.ndim == 2 else data[None]
    if data.dtype == np.uint8:
        return (samples - 128.0) / 128.0, rate, 1.0
    if data.dtype.kind == "i":
        # SciPy returns 24-bit samples in the upper bits of 32-bit integers, so this scale is right for them too.
        return samples / -float(np.iinfo(data.dtype.name).min), rate, 1.0
    return samples, rate, _full_scale(samples)


def _read_with_soundfile(path: Path) -> tuple[np.ndarray, float, float | None]:
    try:
        soundfile: Any = optional("soundfile", "a format that is not plain WAV", "Or convert it to plain WAV.")
    except ImportError as error:
        raise ValueError(str(error)) from None  # like other faults of this file: the caller may read further files
    unread = "not a sound file that soundfile reads"
    with read_as(unread):
        file = soundfile.SoundFile(path)
    with file:
        check_memory(path.name, 16.0 * file.frames * file.channels)
        with read_as(unread):
            data, rate, kind = file.read(file.frames, "float64", always_2d=True), file.samplerate, file.subtype
    # Decoded samples of compressed formats may slightly exceed 1, although their full scale is 1.
    return data.T, rate, _full_scale(data) if kind in ("FLOAT", "DOUBLE") else 1.0


def _full_scale(samples: np.ndarray) -> float | None:
    """Full scale of float samples: 1; or None (unknown) if the magnitude of any sample exceeds 1, since the samples are
    then in another unit."""
    return None if (np.abs(samples[np.isfinite(samples)]) > 1.0).any() else 1.0


# Error message for files of an unknown format.
_UNKNOWN_FORMAT = "neither an NPZ nor a sound file"


# Maximum magnitude of a sample in any unit; squares of larger samples would overflow in single precision.
_LOUDEST = 1e15


class Recording(Module):
    """Simultaneous samples of M microphones.

    **Arguments:**

    - `samples`: samples (M, S) in any unit (volts, counts, fractions of full scale). NaN and infinite samples are kept;
      magnitudes above 1e15 are replaced by infinity.
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
        """Raises `ValueError` for samples that are not real, have another shape than (M, S) or look transposed, and for
        an implausible rate."""
        given = real_array_of(samples, "samples", "microphones, samples")
        beyond = np.abs(given) > _LOUDEST if given.dtype.kind == "f" else np.zeros(0, bool)
        self.samples = np.where(beyond, np.inf, given) if beyond.any() else given
        count, length = self.samples.shape
        if count > length:
            raise ValueError(
                f"samples has shape {self.samples.shape}: {count} microphones with {length} samples each. It looks "
                "transposed: give (microphones, samples)."
            )
        self.rate, self.full_scale, self.name = sampling_rate(rate), check_full_scale(full_scale), name


class Intensities(Module):
    """Band power of M microphones in F time windows.

    **Arguments:**

    - `times`: middle (F,) of each window, seconds.
    - `power`: band power (F, M) minus the noise floor, in the squared unit of the samples. Values may be negative, and
      are NaN only where they are not usable.
    - `floor`: noise power (M,) that was subtracted; zero if unknown.
    - `freedom`: degrees of freedom ν of the power of white noise in a window: its variance is 2 floor² / ν. Infinite if
      unknown.
    - `overlap`: length of a window divided by the hop between windows; 1 if windows do not overlap.
    - `usable`: mask (F, M) of the windows without a fault; by default where `power` is finite.
    - `faults`: M descriptions of the fault of each channel; "" for none.
    - `name`: name of the recording, used in messages.
    - `notes`: remarks on the measurement.

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
        """By default, `usable` and `faults` are derived from NaN, infinite values and dead channels.

        Raises `ValueError` for values that are not real or out of range, for shapes that disagree, and for times that
        do not increase.
        """
        self.times, self.power = (
            real_array_of(times, "times", "windows"),
            real_array_of(power, "intensity", "windows, microphones"),
        )
        shape, length = self.power.shape, len(self.times)
        if shape[0] != length:
            hint = " It looks transposed: give (windows, microphones)." if shape[1] == length else ""
            raise ValueError(f"intensity has shape {shape}, but there are {length} times, one a window.{hint}")
        if not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
            raise ValueError("times must be finite and increasing, in seconds: the middle of each window.")
        self.floor = np.zeros(shape[1]) if floor is None else real_array_of(floor, "floor", "microphones")
        if self.floor.shape != shape[1:] or not (np.isfinite(self.floor) & (self.floor >= 0)).all():
            raise ValueError(
                f"floor must be finite and not negative, one for each of the {shape[1]} microphones; it is "
                f"{short_text(self.floor)}. Leave it out when it is not known."
            )
        self.freedom = real_number(freedom, "freedom")
        if not self.freedom > 0:
            raise ValueError(f"freedom must be positive (infinite when unknown); it is {self.freedom}.")
        self.overlap = real_number(overlap, "overlap")
        if not 1 <= self.overlap <= max(length, 1):
            raise ValueError(
                f"overlap must be at least 1 and no more than the {length} windows: how many of them share a sample "
                f"(window / hop); it is {self.overlap:g}."
            )
        found, reasons = intensity_faults(self.power)
        given = found if usable is None else np.asarray(usable)
        self.faults = reasons if faults is None else tuple(str(reason) for reason in faults)
        if given.shape != shape or given.dtype != bool or len(self.faults) != shape[1]:
            raise ValueError(
                f"usable is {given.dtype} of shape {given.shape} with {len(self.faults)} faults; give booleans of "
                f"shape {shape}, and one string a microphone."
            )
        self.usable, self.name, self.notes = given & np.isfinite(self.power), name, tuple(notes)


class Taps(Module):
    """T touches at known positions, for calibration; d = 2 or 3. Give either `power`, or `samples` and `rate`.

    **Arguments:**

    - `microphones`: positions (M, d) of the microphones, metres.
    - `outline`: vertices (K, d) of the skin's outline in order, metres. A plane outline is ordered counter-clockwise.
    - `positions`: positions (T, d) of the taps, metres.
    - `power`: intensity (T, M) of each tap above the noise floor.
    - `samples`: recording (T, M, S) of each tap.
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
        microphones at the same position, and, on a plane skin, for taps farther outside the outline than 5 % of its
        length.
        """
        self.outline = check_coordinates(outline, "outline", np.shape(microphones)[-1:])
        self.microphones = check_coordinates(microphones, "microphones", self.outline.shape[1:])
        self.positions = check_coordinates(positions, "positions", self.outline.shape[1:])
        if self.outline.shape[1] == 2:
            self.outline = check_loop(self.outline, "outline", clockwise=False)
        elif len(self.outline) < 3:
            raise ValueError(f"outline: expected at least three vertices, got {len(self.outline)}.")
        for label, points in (
            ("outline", self.outline),
            ("microphones", self.microphones),
            ("positions", self.positions),
        ):
            check_extent(np.concatenate([self.outline, points]), label)
        flat = self.outline.shape[1] == 2
        check_microphones(self.microphones, self.outline if flat else np.vstack([self.outline, self.positions]))
        if flat:
            check_taps(self.positions, self.outline)
        if (power is None) == (samples is None):
            both = "neither" if power is None else "both"
            raise ValueError(f"taps need either intensity or samples with their rate; {both} were given.")
        expected = (len(self.positions), len(self.microphones))
        self.power = None if power is None else real_array_of(power, "intensity", "taps, microphones")
        self.samples = None if samples is None else real_array_of(samples, "samples", "taps, microphones, samples")
        label, given = ("intensity", self.power) if self.samples is None else ("samples", self.samples)
        assert given is not None
        if given.shape[:2] != expected:
            transposed = given.shape == expected[::-1] or (given.ndim == 3 and given.shape[::2] == expected)
            hint = " It looks transposed." if transposed else ""
            raise ValueError(
                f"{label} has shape {given.shape}, but there are {expected[0]} positions and {expected[1]} "
                f"microphones: give (taps, microphones{', samples' if given.ndim == 3 else ''}).{hint}"
            )
        if self.samples is not None and rate is None:
            raise ValueError("rate is missing: samples need the samples a second of each microphone, in Hz.")
        self.rate = None if self.samples is None else sampling_rate(rate)
        self.full_scale, self.name = check_full_scale(full_scale), name


def read_recording(path: str | Path) -> Recording | Intensities:
    """Read a recording from a WAV file with any number of channels, from an NPZ file, or, if `soundfile` is installed,
    from another sound file (FLAC, Ogg, AIFF, …).

    An NPZ file contains either `samples` (M, S), `rate` in Hz and optionally `full_scale`; or `intensity` (F, M),
    `times` (F,) in seconds and optionally `floor` (M,), `freedom` and `overlap`, as in `Intensities`. Integer samples
    of a sound file are converted to fractions of full scale, from -1 to 1.

    **Arguments:**

    - `path`: path of the file.

    Raises `ValueError` for any other content, and `OSError` if the file cannot be opened.

    **Example:**

    ```python
    write_recording("recording.npz", recording)
    same = read_recording("recording.npz")
    ```
    """
    path = Path(path)
    try:
        sound = read_sound(path)
        if sound is not None:
            samples, rate, full_scale = sound
            return Recording(samples, rate, full_scale=full_scale, name=path.stem)
        optional = ("floor", "freedom", "overlap")
        arrays = npz_arrays(
            path, "samples", "rate", "full_scale", "intensity", "times", *optional, otherwise=_UNKNOWN_FORMAT
        )
        kind = choose_array(arrays, "intensity", "samples")
        if kind == "samples":
            if arrays["samples"].ndim == 3:
                raise ValueError("samples has three axes, as a file of taps has: read that with read_taps.")
            need(arrays, "rate")
            return Recording(arrays["samples"], arrays["rate"], full_scale=arrays.get("full_scale"), name=path.stem)
        need(arrays, "times")
        known = {key: arrays[key] for key in optional if key in arrays}
        return Intensities(arrays["times"], arrays["intensity"], **known, name=path.stem)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def read_taps(path: str | Path) -> Taps:
    """Read calibration taps from an NPZ file.

    The file contains `microphones` (M, d), `outline` (K, d) and `positions` (T, d) in metres; either `intensity` (T, M)
    or `samples` (T, M, S) and `rate` in Hz; and optionally `full_scale`.

    **Arguments:**

    - `path`: path of the file.

    Raises `ValueError` for other content, and `OSError` if the file cannot be opened.

    **Example:**

    ```python
    write_taps("taps.npz", taps)
    same = read_taps("taps.npz")
    ```
    """
    path = Path(path)
    geometry = ("microphones", "outline", "positions")
    try:
        asked = (*geometry, "intensity", "samples", "rate", "full_scale")
        arrays = npz_arrays(path, *asked, otherwise=_UNKNOWN_FORMAT)
        need(arrays, *geometry)
        kind = choose_array(arrays, "intensity", "samples")
        values = {"power" if kind == "intensity" else "samples": arrays[kind]}
        if kind == "samples":
            need(arrays, "rate")
            values |= {"rate": arrays["rate"]}
        full_scale = arrays.get("full_scale")
        return Taps(*(arrays[key] for key in geometry), **values, full_scale=full_scale, name=path.stem)
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
        known = {key: getattr(recording, key) for key in ("times", "floor", "freedom", "overlap")}
        _write_npz(path, intensity=np.where(recording.usable, recording.power, np.nan), **known)


def write_taps(path: str | Path, taps: Taps) -> None:
    """Write taps to an NPZ file for `read_taps`.

    **Arguments:**

    - `path`: path of the file.
    - `taps`: the taps.

    **Example:**

    ```python
    write_taps("taps.npz", taps)
    same = read_taps("taps.npz")
    ```
    """
    geometry = {"microphones": taps.microphones, "outline": taps.outline, "positions": taps.positions}
    _write_npz(path, **geometry, intensity=taps.power, samples=taps.samples, rate=taps.rate, full_scale=taps.full_scale)


def _write_npz(path: str | Path, **arrays) -> None:
    with written_whole(path) as file:
        np.savez(file, allow_pickle=False, **{key: value for key, value in arrays.items() if value is not None})
