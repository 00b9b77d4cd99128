"""Files of recordings and taps: written data are read again, and bad data are refused in one line that says why."""

import wave
import zipfile

import numpy as np
import pytest
import scipy.io.wavfile

from jeit.acoustic.signal.recording import (
    Intensities,
    Recording,
    Taps,
    read_recording,
    read_taps,
    write_recording,
    write_taps,
)

RANDOM = np.random.default_rng(0)
SAMPLES = RANDOM.uniform(-0.9, 0.9, size=(3, 400))
POWER = RANDOM.uniform(size=(6, 3))
TIMES = np.arange(6) * 0.01
SQUARE = np.array([[0, 0], [0.2, 0], [0.2, 0.2], [0, 0.2]])
GEOMETRY = {"microphones": SQUARE[:3] + 0.01, "outline": SQUARE, "positions": RANDOM.uniform(0, 0.2, size=(5, 2))}
TAPS = {**GEOMETRY, "intensity": RANDOM.uniform(size=(5, 3))}
RECORDED_TAPS = {**GEOMETRY, "samples": RANDOM.normal(size=(5, 3, 60)), "rate": 40e3}


@pytest.mark.parametrize("dtype", ["int16", "int32", "uint8", "float32", "float64"])
@pytest.mark.parametrize("channels", [1, 3])
def test_wav(tmp_path, dtype, channels):
    """Equal to half a step of the format."""
    samples = SAMPLES[:channels].copy()
    samples[0, :2] = [-1, 0]
    bits = np.dtype(dtype).itemsize * 8
    if dtype == "uint8":
        data, step = np.round(samples * 128 + 128), 2.0**-7
    elif dtype.startswith("int"):
        data, step = np.round(samples * 2 ** (bits - 1)), 2.0 ** (1 - bits)
    else:
        data, step = samples, 1e-7
    scipy.io.wavfile.write(tmp_path / "sound.wav", 8000, data.T.astype(dtype))
    found = read_recording(tmp_path / "sound.wav")
    assert isinstance(found, Recording)
    assert (found.rate, found.full_scale, found.name) == (8000, 1.0, "sound")
    np.testing.assert_allclose(found.samples, samples, atol=step / 2 * 1.001, rtol=0)
    assert found.samples[0, 0] == -1
    assert found.samples[0, 1] == 0


def test_wav_of_24_bits(tmp_path):
    data = np.round(SAMPLES * 2**23).astype("<i4")
    with wave.open(str(tmp_path / "sound.wav"), "wb") as file:
        file.setnchannels(3)
        file.setsampwidth(3)
        file.setframerate(44100)
        file.writeframes(data.T.copy().view(np.uint8).reshape(-1, 4)[:, :3].tobytes())
    found = read_recording(tmp_path / "sound.wav")
    assert isinstance(found, Recording)
    np.testing.assert_array_equal(found.samples, data / 2.0**23)


def test_wav_of_floats_beyond_one(tmp_path):
    """They are volts, pascals or counts: full scale is not known."""
    scipy.io.wavfile.write(tmp_path / "sound.wav", 8000, 30 * SAMPLES.T)
    found = read_recording(tmp_path / "sound.wav")
    assert isinstance(found, Recording)
    assert found.full_scale is None
    np.testing.assert_array_equal(found.samples, 30 * SAMPLES)


@pytest.mark.parametrize("full_scale", [None, 2.5])
def test_recording_round_trip(tmp_path, full_scale):
    samples = SAMPLES.copy()
    samples[1, 5], samples[2] = np.nan, 0
    write_recording(tmp_path / "touch", Recording(samples, 40e3, full_scale=full_scale))
    found = read_recording(tmp_path / "touch")
    assert isinstance(found, Recording)
    assert (found.rate, found.full_scale, found.name) == (40e3, full_scale, "touch")
    np.testing.assert_array_equal(found.samples, samples)


def test_intensities_round_trip(tmp_path):
    power = POWER.copy()
    power[2, 1], power[:, 2] = np.nan, np.nan
    written = Intensities(
        TIMES, power, floor=[0.1, 0.2, 0.3], freedom=49.5, overlap=4.0, usable=np.isfinite(power) & (TIMES > 0)[:, None]
    )
    write_recording(tmp_path / "touch.npz", written)
    found = read_recording(str(tmp_path / "touch.npz"))
    assert isinstance(found, Intensities)
    np.testing.assert_array_equal(found.usable, written.usable)
    np.testing.assert_array_equal(found.power[found.usable], power[written.usable])
    np.testing.assert_array_equal(found.times, TIMES)
    np.testing.assert_array_equal(found.floor, [0.1, 0.2, 0.3])
    assert (found.freedom, found.overlap) == (49.5, 4.0)
    assert found.faults[1:] == ("NaN or infinite in 2 of 6 windows", "dead: every intensity is NaN or infinite")


def test_intensities_alone(tmp_path):
    np.savez(tmp_path / "touch.npz", intensity=POWER - 0.5, times=TIMES)
    found = read_recording(tmp_path / "touch.npz")
    assert isinstance(found, Intensities)
    np.testing.assert_array_equal(found.power, POWER - 0.5)
    np.testing.assert_array_equal(found.floor, 0)
    assert np.isinf(found.freedom)
    assert found.overlap == 1
    assert found.usable.all()
    assert found.faults == ("", "", "")


@pytest.mark.parametrize("arrays", [TAPS, RECORDED_TAPS, {**RECORDED_TAPS, "full_scale": 2.0}])
@pytest.mark.parametrize("dimension", [2, 3])
def test_taps_round_trip(tmp_path, arrays, dimension):
    if dimension == 3:
        arrays = {**arrays, **{key: np.insert(arrays[key], 2, 0.01, axis=1) for key in GEOMETRY}}
    np.savez(tmp_path / "taps.npz", **arrays)
    first = read_taps(tmp_path / "taps.npz")
    write_taps(tmp_path / "again.npz", first)
    for found in (first, read_taps(str(tmp_path / "again.npz"))):
        for key in GEOMETRY:
            np.testing.assert_array_equal(getattr(found, key), arrays[key])
        for held, key in ((found.power, "intensity"), (found.samples, "samples"), (found.rate, "rate")):
            assert (held is None) == (key not in arrays)
            if held is not None:
                np.testing.assert_array_equal(held, arrays[key])
        assert found.full_scale == arrays.get("full_scale")
    assert first.name == "taps"


def test_numbers_keep_their_kind():
    """Counts become floats. Single precision is kept, since it halves the memory of a long recording."""
    assert Recording(SAMPLES.astype(np.float32), 8000).samples.dtype == np.float32
    assert Recording((100 * SAMPLES).astype(np.int16), np.array([8000])).samples.dtype == float
    clockwise = Taps(SQUARE[:2], SQUARE[::-1], SQUARE[:1], power=[[1, 2]])
    assert sorted(map(tuple, clockwise.outline)) == sorted(map(tuple, SQUARE))
    x, y = clockwise.outline.T
    assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == pytest.approx(0.04)


def test_microphones_and_taps_may_be_slightly_outside_the_outline():
    """Under a rim, or pressed at the edge: by a skin's length for microphones, and by a twentieth of it for taps."""
    beside = Taps(SQUARE[:2] - np.array([0.0, 0.199]), SQUARE, SQUARE + np.array([0.0099, 0.0]), power=np.ones((4, 2)))
    np.testing.assert_allclose(beside.positions[1], [0.2099, 0])


def without(arrays, *keys):
    return {key: value for key, value in arrays.items() if key not in keys}


SOUND = {"samples": SAMPLES, "rate": 40e3}
FRAMES = {"intensity": POWER, "times": TIMES}
MISSING = np.where(np.arange(10).reshape(5, 2) == 3, np.nan, 0.1)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"rate": 40e3, "sound": SAMPLES}, "neither 'samples' nor 'intensity'; the file holds rate, sound"),
        ({}, "neither"),
        ({"samples": SAMPLES, "Rate": 40e3}, "no array 'rate'; the file holds samples, Rate"),
        ({"intensity": POWER}, "no array 'times'"),
        ({**SOUND, **FRAMES}, "both 'intensity' and 'samples'"),
        (RECORDED_TAPS, "read_taps"),
        ({"samples": SAMPLES.T, "rate": 40e3}, "transposed"),
        ({"samples": SAMPLES[0], "rate": 40e3}, r"shape \(400,\); give \(microphones, samples\)"),
        ({"samples": SAMPLES[:, :0], "rate": 40e3}, "empty"),
        ({"samples": SAMPLES + 0j, "rate": 40e3}, "complex128; give real"),
        ({"samples": SAMPLES.astype(str), "rate": 40e3}, "<U"),
        ({"samples": SAMPLES > 0, "rate": 40e3}, "bool"),
        ({"samples": SAMPLES.astype(object), "rate": 40e3}, "holds objects"),
        ({"samples": SAMPLES, "rate": 0.0}, "rate is 0"),
        ({"samples": SAMPLES, "rate": -40e3}, "rate is -40000"),
        ({"samples": SAMPLES, "rate": np.nan}, "rate is nan"),
        ({"samples": SAMPLES, "rate": np.inf}, "rate is inf"),
        ({"samples": SAMPLES, "rate": 40.0}, "Hz"),
        ({"samples": SAMPLES, "rate": 25e-6}, "Hz"),
        ({"samples": SAMPLES, "rate": [40e3] * 3}, "rate must be one real number"),
        ({"samples": SAMPLES, "rate": "40 kHz"}, "rate must be one real number"),
        ({**SOUND, "full_scale": 0.0}, "full_scale"),
        ({**SOUND, "full_scale": [1, 1]}, "full_scale must be one"),
        ({**FRAMES, "times": TIMES[:5]}, "there are 5 times"),
        ({**FRAMES, "intensity": POWER.T}, "transposed"),
        ({**FRAMES, "times": TIMES[::-1]}, "increasing"),
        ({**FRAMES, "times": TIMES * 0}, "increasing"),
        ({**FRAMES, "times": TIMES * np.nan}, "increasing"),
        ({**FRAMES, "times": TIMES[:, None]}, r"times has shape \(6, 1\)"),
        ({"intensity": POWER[:0], "times": TIMES[:0]}, "empty"),
        ({**FRAMES, "intensity": POWER * 1j}, "complex"),
        ({**FRAMES, "floor": [0.1, 0.2]}, "each of the 3 microphones"),
        ({**FRAMES, "floor": [0.1, -0.2, 0.1]}, "not negative"),
        ({**FRAMES, "floor": [0.1, np.nan, 0.1]}, "finite"),
        ({**FRAMES, "freedom": 0.0}, "freedom must be positive"),
        ({**FRAMES, "freedom": np.nan}, "freedom must be positive"),
        ({**FRAMES, "overlap": 1e6}, r"no more than the .* windows.* it is 1e\+06"),
        ({**FRAMES, "overlap": 0.25}, r"overlap must be at least 1 .*window / hop.* it is 0.25"),
        ({**FRAMES, "overlap": np.inf}, "overlap must be at least 1"),
        ({**FRAMES, "overlap": np.nan}, "overlap must be at least 1"),
        ({**FRAMES, "overlap": [4.0, 4.0]}, "overlap must be one real number"),
    ],
)
def test_bad_recordings(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(ValueError, match=message) as caught:
        read_recording(tmp_path / "bad.npz")
    assert str(caught.value).startswith("bad.npz: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (SOUND, "no array 'microphones'"),
        (without(TAPS, "outline"), "no array 'outline'; the file holds microphones, positions, intensity"),
        (without(TAPS, "positions"), "no array 'positions'"),
        (without(TAPS, "intensity"), "neither 'samples' nor 'intensity'"),
        ({**TAPS, **RECORDED_TAPS}, "both"),
        (without(RECORDED_TAPS, "rate"), "no array 'rate'"),
        ({**RECORDED_TAPS, "rate": 1.0}, "rate is 1"),
        ({**TAPS, "positions": 1000 * TAPS["positions"]}, "positions .* metres"),
        ({**TAPS, "microphones": 1000 * TAPS["microphones"]}, "microphones .* metres"),
        ({**TAPS, **{key: 1000 * TAPS[key] for key in GEOMETRY}}, "outline .* metres"),
        ({**TAPS, "positions": [[50.0, 60.0]], "intensity": TAPS["intensity"][:1]}, "positions .* metres"),
        ({**TAPS, "positions": MISSING}, r"positions: row 1 is \[0.1, nan\]"),
        ({**TAPS, "microphones": np.full((3, 2), np.inf)}, "microphones: row 0"),
        ({**TAPS, "outline": SQUARE[:2]}, "at least three"),
        ({**TAPS, "outline": SQUARE[[0, 1, 3, 2]]}, "crosses"),
        ({**TAPS, "outline": SQUARE[[0, 1, 2, 3, 0]]}, "Do not repeat"),
        ({**TAPS, "outline": np.full((4, 2), 0.1)}, "coincide"),
        ({**TAPS, "positions": np.zeros((5, 3))}, "as many for microphones, outline and positions"),
        ({**TAPS, "microphones": np.zeros((3, 1)), "positions": np.zeros((5, 1))}, "2 or 3 coordinates"),
        ({**TAPS, "positions": np.zeros(2)}, r"positions has shape \(2,\)"),
        ({**TAPS, "positions": np.zeros((0, 2))}, "positions is empty"),
        ({**TAPS, "intensity": TAPS["intensity"].T}, "transposed"),
        ({**TAPS, "intensity": TAPS["intensity"][:4]}, "there are 5 positions and 3 microphones"),
        ({**RECORDED_TAPS, "samples": RECORDED_TAPS["samples"].swapaxes(1, 2)}, "transposed"),
        ({**RECORDED_TAPS, "samples": RECORDED_TAPS["samples"][0]}, r"\(taps, microphones, samples\)"),
        ({**TAPS, "microphones": np.array([["a", "b"]] * 3)}, "microphones is <U1"),
        ({**TAPS, **{k: np.insert(TAPS[k][:2], 2, 0, axis=1) for k in GEOMETRY}}, "at least three"),
        ({**TAPS, "microphones": SQUARE[[0, 1, 1]]}, r"numbers 1 and 2 are at the same place, \[0.2, 0.0\]"),
        (
            {**TAPS, "microphones": 10 * SQUARE[:3]},
            r"number 2 at \[2.0, 2.0\] is 2.55 m away .* 0.2 m long: .* Divide millimetres by 1000",
        ),
        (
            {**TAPS, **{k: np.insert(TAPS[k], 2, 0, axis=1) for k in GEOMETRY}, "microphones": np.eye(3)},
            r"number 2 at \[0.0, 0.0, 1.0\] .* metres",
        ),
        (
            {**TAPS, "positions": [*TAPS["positions"][:4], [0.1, -0.0101]]},
            r"positions: row 4, \[0.1, -0.0101\], is 10.1 mm outside the outline; .* within 10 mm",
        ),
        (
            {
                **TAPS,
                "outline": np.insert(SQUARE, 3, [0.1, 0.1], axis=0)[[0, 1, 3, 4]],
                "positions": [[0.15, 0.15]] * 5,
            },
            "row 0, .* is 70.7 mm outside",
        ),
    ],
)
def test_bad_taps(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(ValueError, match=message) as caught:
        read_taps(tmp_path / "bad.npz")
    assert str(caught.value).startswith("bad.npz: ")
    assert "\n" not in str(caught.value)


def files(folder):
    """Files of other kinds, each with a word of the expected message."""
    scipy.io.wavfile.write(folder / "good.wav", 8000, SAMPLES.T)
    np.savez(folder / "good.npz", **SOUND)
    for name, content, word in (
        ("empty.npz", b"", "neither an NPZ nor a sound"),
        ("text.npz", b"1,2,3\n4,5,6\n", "neither an NPZ nor a sound"),
        ("cut.npz", (folder / "good.npz").read_bytes()[:2000], "not a readable NPZ"),
        ("corrupt.npz", (folder / "good.npz").read_bytes().replace(SAMPLES[1].tobytes(), SAMPLES[2].tobytes()), "CRC"),
        ("cut.wav", (folder / "good.wav").read_bytes()[:2000], "cut off"),
        ("cut_between.wav", (folder / "good.wav").read_bytes()[:-240], "cut off"),
        ("head.wav", (folder / "good.wav").read_bytes()[:20], "not a readable WAV"),
        ("riff.wav", b"RIFF" + bytes(60), "not a readable WAV"),
        ("avi.wav", b"RIFF\x20\0\0\0AVI " + bytes(60), "not a readable WAV"),
    ):
        (folder / name).write_bytes(content)
        yield folder / name, word
    np.save(folder / "single.npy", SAMPLES)
    yield folder / "single.npy", "single array"
    with zipfile.ZipFile(folder / "other.zip", "w") as archive:
        archive.writestr("letter.txt", "dear reader")
    yield folder / "other.zip", "letter.txt"
    with zipfile.ZipFile(folder / "named.zip", "w") as archive:
        archive.writestr("samples", "dear reader")
        archive.writestr("rate", "40000")
    yield folder / "named.zip", "plain arrays"


def test_bad_files(tmp_path):
    messages = {}
    for path, word in files(tmp_path):
        with pytest.raises(ValueError, match=word) as caught:
            read_recording(path)
        assert str(caught.value).startswith(f"{path.name}: ")
        assert "\n" not in str(caught.value)
        messages[path.name] = str(caught.value)
    assert len(messages) == 12
    with pytest.raises(ValueError, match="neither an NPZ"):
        read_taps(tmp_path / "good.wav")
    for read in (read_recording, read_taps):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Recording([[1, 2, 3], [1, 2]], 8000), "rows differ in length"),
        (lambda: Taps(SQUARE, SQUARE, SQUARE, samples=np.zeros((4, 4, 9))), "rate is missing"),
        (lambda: Taps(SQUARE, SQUARE, SQUARE), "neither were given"),
        (lambda: Intensities(TIMES, POWER, usable=np.ones(6, bool)), "usable"),
        (lambda: Intensities(TIMES, POWER, usable=np.ones((6, 3))), "usable is float64"),
        (lambda: Intensities(TIMES, POWER, faults=("", "")), "one string a microphone"),
    ],
)
def test_bad_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
