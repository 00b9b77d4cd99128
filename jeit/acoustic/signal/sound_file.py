"""Sound files: WAV by SciPy, and FLAC, Ogg, AIFF and others by `soundfile`, where that is installed."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io.wavfile

from jeit.arguments.extras import optional
from jeit.files import check_memory, read_as, reason

# Bytes of memory for each byte of a file with eight bits per sample.
_IN_MEMORY = 16
# First bytes of other formats: FLAC, Ogg, AIFF, CAF, AU, Wave64, VOC, MP3 with a tag.
_OTHERS = (b"fLaC", b"OggS", b"FORM", b"caff", b".snd", b"riff", b"Creative", b"ID3")
# Formats that soundfile does not read either: MP4 from its fifth byte on, WebM, WMA, AMR.
_MP4, _CLOSED = b"ftyp", (b"\x1aE\xdf\xa3", b"0&\xb2u", b"#!AMR")


def read_sound(path: Path) -> tuple[np.ndarray, float, float | None] | None:
    """Samples (M, S), rate in Hz and full scale of a sound file; None for a file of an unknown format.

    Integers become fractions of full scale, -1 to 1; floats are unchanged, and where they exceed 1 the full scale is
    unknown. Raises `ValueError` for broken files, and for those that need `soundfile` where it is not installed.
    """
    check_memory(path.name, _IN_MEMORY * path.stat().st_size)
    with path.open("rb") as file:
        start = file.read(8)
    if start.startswith((b"RIFF", b"RIFX", b"RF64")):
        return _read_wav(path)
    if start.startswith(_OTHERS) or _is_mp3(start):
        return _read_other(path)
    if start[4:] == _MP4 or start.startswith(_CLOSED):
        raise ValueError(
            f"a format that is not read (M4A, MP4, WebM, WMA, AMR); convert it: ffmpeg -i '{path.name}' "
            f"'{path.stem}.wav'."
        )
    return None


def _is_mp3(start: bytes) -> bool:
    """Whether a frame of MPEG layer III begins: eleven bits that are set, any version, and the layer."""
    return len(start) > 1 and start[0] == 0xFF and start[1] & 0xE6 == 0xE2


def _read_wav(path: Path) -> tuple[np.ndarray, float, float | None]:
    problem, rate, data = None, 0, np.zeros(0)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            rate, data = scipy.io.wavfile.read(path)
        except Exception as error:  # of many kinds: it stumbles over what is damaged
            problem = error
    # The reader only warns of these, or stumbles later; its other warnings are of chunks that hold no sound.
    if any("prematurely" in str(one.message) for one in said):
        raise ValueError("the WAV file is cut off: it holds fewer samples than its header says. Copy it again.")
    if "Unknown wave file format" in str(problem):  # A-law, ADPCM, and such
        return _read_other(path)
    if problem is not None:
        raise ValueError(f"not a readable WAV file, or cut off ({reason(problem)}); write it as plain PCM or float.")
    samples = data.T if data.ndim == 2 else data[None]
    if data.dtype == np.uint8:
        return (samples - 128.0) / 128.0, rate, 1.0
    if data.dtype.kind == "i":
        # 24 bits come as the upper bits of 32, so that this holds for them too.
        return samples / -float(np.iinfo(data.dtype.name).min), rate, 1.0
    return samples, rate, _full_scale(samples)


def _read_other(path: Path) -> tuple[np.ndarray, float, float | None]:
    try:
        soundfile: Any = optional("soundfile", "a format that is not plain WAV", "Or convert it to plain WAV.")
    except ImportError as error:
        raise ValueError(str(error)) from None  # of this file, as other faults are: further files may be read
    unread = "not a sound file that soundfile reads"
    with read_as(unread):
        file = soundfile.SoundFile(path)
    with file:
        check_memory(path.name, 16.0 * file.frames * file.channels)
        with read_as(unread):
            data, rate, kind = file.read(file.frames, "float64", always_2d=True), file.samplerate, file.subtype
    # What is compressed may overshoot 1 a little; its full scale is 1 all the same.
    return data.T, rate, _full_scale(data) if kind in ("FLOAT", "DOUBLE") else 1.0


def _full_scale(samples: np.ndarray) -> float | None:
    """Full scale of float samples: 1, or None (unknown) if any exceed 1, since they are then in some other unit."""
    return None if (np.abs(samples[np.isfinite(samples)]) > 1.0).any() else 1.0
