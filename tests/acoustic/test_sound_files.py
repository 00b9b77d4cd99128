"""Sound files of other formats than WAV, read through soundfile, and messages for formats that nothing reads."""

import sys
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.io import wavfile

from jeit.acoustic import Recording, read_recording

needs_soundfile = pytest.mark.skipif(
    find_spec("soundfile") is None, reason="soundfile is not installed: pip install 'jeit[sound]'"
)
# For each: suffix, format and subtype as soundfile names them, and the tolerance of the samples.
_KINDS = {
    "flac": ("flac", "FLAC", "PCM_16", 1e-4),
    "flac-24": ("flac", "FLAC", "PCM_24", 1e-6),
    "ogg": ("ogg", "OGG", "VORBIS", 0.05),
    "aiff-24": ("aiff", "AIFF", "PCM_24", 1e-6),
    "wav-24": ("wav", "WAV", "PCM_24", 1e-6),
    "wav-many-24": ("wav", "WAVEX", "PCM_24", 1e-6),
    "wav-a-law": ("wav", "WAV", "ALAW", 0.02),
    "wave64": ("w64", "W64", "PCM_16", 1e-4),
}


def _tones(rate: int, channels: int) -> np.ndarray:
    """0.3 s of a different tone on each channel, nearly full scale at its loudest (S, channels)."""
    times = np.arange(round(0.3 * rate)) / rate
    return 0.9 * np.column_stack([np.sin(2 * np.pi * 200 * (1 + one) * times) for one in range(channels)])


@needs_soundfile
@pytest.mark.parametrize("rate", [8000, 22_050, 44_100, 48_000, 96_000])
@pytest.mark.parametrize("kind", _KINDS)
def test_formats_of_soundfile_are_read(kind, rate, tmp_path):
    """Every sample, of one, two and five channels."""
    import soundfile  # pyright: ignore[reportMissingImports]

    suffix, named, subtype, off = _KINDS[kind]
    for channels in (1, 2, 5):
        made = _tones(rate, channels)
        soundfile.write(tmp_path / f"made.{suffix}", made, rate, format=named, subtype=subtype)
        read = read_recording(tmp_path / f"made.{suffix}")
        assert isinstance(read, Recording)
        assert read.rate == rate
        assert read.full_scale == 1
        np.testing.assert_allclose(read.samples.T, made, atol=off * (3 if channels > 2 else 1))


@needs_soundfile
def test_mp3_is_read_of_any_version(tmp_path):
    """Its first bytes depend on its rate. Its samples are nearly the original ones."""
    import soundfile  # pyright: ignore[reportMissingImports]

    if "MP3" not in soundfile.available_formats():
        pytest.skip("this libsndfile has no MP3")
    for rate in (8000, 22_050, 44_100):
        soundfile.write(tmp_path / "made.mp3", _tones(rate, 1), rate, format="MP3")
        read = read_recording(tmp_path / "made.mp3")
        assert isinstance(read, Recording)
        assert read.rate == rate
        assert np.abs(read.samples).max() == pytest.approx(0.9, abs=0.15)


@needs_soundfile
@pytest.mark.parametrize("kind", ["flac", "ogg"])
def test_truncation_is_reported(kind, tmp_path):
    import soundfile  # pyright: ignore[reportMissingImports]

    suffix, named, subtype, _ = _KINDS[kind]
    soundfile.write(tmp_path / f"made.{suffix}", _tones(44_100, 2), 44_100, format=named, subtype=subtype)
    whole = (tmp_path / f"made.{suffix}").read_bytes()
    for length in (6, 200, len(whole) // 2):
        (tmp_path / f"cut.{suffix}").write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"^cut\.\w+: not a sound file that soundfile reads"):
            read_recording(tmp_path / f"cut.{suffix}")


def test_a_missing_soundfile_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "soundfile", None)
    (tmp_path / "one.flac").write_bytes(b"fLaC and more")
    with pytest.raises(ValueError, match=r"one\.flac: a format .* needs soundfile: pip install 'jeit\[sound\]'"):
        read_recording(tmp_path / "one.flac")
    wavfile.write(tmp_path / "law.wav", 8000, np.zeros(100, np.int16))
    plain = bytearray((tmp_path / "law.wav").read_bytes())
    plain[20:22] = (6).to_bytes(2, "little")
    (tmp_path / "law.wav").write_bytes(plain)
    with pytest.raises(ValueError, match=r"law\.wav: a format that is not plain WAV needs soundfile"):
        read_recording(tmp_path / "law.wav")


@pytest.mark.parametrize(
    "start", [b"\0\0\0\x20ftypM4A ", b"\x1aE\xdf\xa3webm", b"0&\xb2u\x8ef\xcf\x11", b"#!AMR\n and more"]
)
def test_unreadable_formats_are_refused_with_how_to_convert_them(start, tmp_path):
    (tmp_path / "tap.m4a").write_bytes(start + bytes(100))
    with pytest.raises(ValueError, match=r"tap\.m4a: a format that is not read .*ffmpeg -i 'tap\.m4a' 'tap\.wav'"):
        read_recording(tmp_path / "tap.m4a")


def test_a_sound_that_would_not_fit_in_memory_is_refused_before_it_is_read(tmp_path, monkeypatch):
    """Samples take up to sixteen times the bytes of their file."""
    wavfile.write(tmp_path / "long.wav", 8000, np.zeros(8000, np.uint8))
    monkeypatch.setenv("JEIT_FILE_GB", "0.0001")
    with pytest.raises(ValueError, match=r"long.wav would take 0.000129 GB in memory, more than the 0.0001 GB"):
        read_recording(tmp_path / "long.wav")
