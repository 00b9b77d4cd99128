"""Reading of sound files: WAV, and further formats if the package `soundfile` is installed."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io.wavfile

from jeit.arguments.extras import import_optional
from jeit.files import check_memory, error_text, read_as

# Bytes of memory needed per byte of a sound file with eight bits per sample.
_MEMORY_PER_FILE_BYTE = 16
# First bytes of the formats read by `soundfile`: FLAC, Ogg, AIFF, CAF, AU, Wave64, VOC, MP3 with a tag.
_SOUNDFILE_SIGNATURES = (b"fLaC", b"OggS", b"FORM", b"caff", b".snd", b"riff", b"Creative", b"ID3")
# Bytes that identify formats which `soundfile` does not read: MP4 (from the fifth byte on); WebM, WMA and AMR.
_MP4_SIGNATURE, _UNREADABLE_STARTS = b"ftyp", (b"\x1aE\xdf\xa3", b"0&\xb2u", b"#!AMR")


def read_sound(path: Path) -> tuple[np.ndarray, float, float | None] | None:
    """Read the samples (M, S), the sampling rate in Hz and the full scale of a sound file. Returns None if the format
    is unknown.

    Integer samples are converted to fractions of full scale, from -1 to 1. Float samples are unchanged; if the
    magnitude of any float exceeds 1, the full scale is None (unknown). Raises `ValueError` for broken files, for
    formats that cannot be read, and if `soundfile` is needed but not installed.
    """
    check_memory(path.name, _MEMORY_PER_FILE_BYTE * path.stat().st_size)
    with path.open("rb") as sound_file:
        first_bytes = sound_file.read(8)
    if first_bytes.startswith((b"RIFF", b"RIFX", b"RF64")):
        return _read_wav(path)
    if first_bytes.startswith(_SOUNDFILE_SIGNATURES) or _is_mp3(first_bytes):
        return _read_with_soundfile(path)
    if first_bytes[4:] == _MP4_SIGNATURE or first_bytes.startswith(_UNREADABLE_STARTS):
        raise ValueError(
            f"a format that is not read (M4A, MP4, WebM, WMA, AMR); convert it: ffmpeg -i '{path.name}' "
            f"'{path.stem}.wav'."
        )
    return None


def _is_mp3(first_bytes: bytes) -> bool:
    """Whether the bytes `first_bytes` begin an MP3 frame: eleven bits that are 1, any version, and layer III."""
    return len(first_bytes) > 1 and first_bytes[0] == 0xFF and first_bytes[1] & 0xE6 == 0xE2


def _read_wav(wav_path: Path) -> tuple[np.ndarray, float, float | None]:
    read_error, rate_hz, wav_data = None, 0, np.zeros(0)
    with warnings.catch_warnings(record=True) as caught_warnings:
        warnings.simplefilter("always")
        try:
            rate_hz, wav_data = scipy.io.wavfile.read(wav_path)
        except Exception as error:  # SciPy raises exceptions of many types for damaged files
            read_error = error
    # SciPy only warns of a truncated file, or fails later. Other warnings of SciPy concern chunks without sound.
    if any("prematurely" in str(caught_warning.message) for caught_warning in caught_warnings):
        raise ValueError("the WAV file is cut off: it holds fewer samples than its header says. Copy it again.")
    if "Unknown wave file format" in str(read_error):  # A-law or ADPCM, for example
        return _read_with_soundfile(wav_path)
    if read_error is not None:
        raise ValueError(
            f"not a readable WAV file, or cut off ({error_text(read_error)}); write it as plain PCM or float."
        )
    samples = wav_data.T if wav_data.ndim == 2 else wav_data[None]
    if wav_data.dtype == np.uint8:
        return (samples - 128.0) / 128.0, rate_hz, 1.0
    if wav_data.dtype.kind == "i":
        # SciPy returns 24-bit samples in the upper bits of 32-bit integers, so this scale is right for 24-bit samples
        # too.
        return samples / -float(np.iinfo(wav_data.dtype.name).min), rate_hz, 1.0
    return samples, rate_hz, _full_scale(samples)


def _read_with_soundfile(sound_path: Path) -> tuple[np.ndarray, float, float | None]:
    try:
        soundfile: Any = import_optional("soundfile", "a format that is not plain WAV", "Or convert it to plain WAV.")
    except ImportError as error:
        raise ValueError(str(error)) from None  # the caller may read further files
    error_message = "not a sound file that soundfile reads"
    with read_as(error_message):
        sound_file = soundfile.SoundFile(sound_path)
    with sound_file:
        check_memory(sound_path.name, 16.0 * sound_file.frames * sound_file.channels)
        with read_as(error_message):
            sound_data, rate_hz, sample_format = (
                sound_file.read(sound_file.frames, "float64", always_2d=True),
                sound_file.samplerate,
                sound_file.subtype,
            )
    # Decoded samples of compressed formats may slightly exceed 1, although the full scale is 1.
    return sound_data.T, rate_hz, _full_scale(sound_data) if sample_format in ("FLOAT", "DOUBLE") else 1.0


def _full_scale(samples: np.ndarray) -> float | None:
    """Full scale of float samples: 1; or None (unknown) if the magnitude of any sample exceeds 1, since the samples are
    then in a different unit."""
    return None if (np.abs(samples[np.isfinite(samples)]) > 1.0).any() else 1.0
