"""`jeit calibrate-microphones` and `jeit locate`: the files that they read and write, and one line for every invalid
input."""

import contextlib
import csv
import io
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.io import wavfile

from jeit.acoustic import (
    Calibration,
    IntensitySettings,
    calibrate_microphones,
    locate_touches,
    read_recording,
    read_taps,
    write_recording,
)
from jeit.acoustic.calibration.calibration import calibrated_intensities
from jeit.acoustic.commands.calibrate_microphones import _parameter_table
from jeit.acoustic.commands.locate import _table_rows
from jeit.acoustic.decay import Exponential
from jeit.acoustic.localisation.locations import LocationStatus
from jeit.acoustic.reports import write_calibration, write_track
from jeit.cli import main
from jeit.layout import grid

OUTLINE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
MICROPHONES = grid(0.14, 0.14, 3, 3)
RATE = 4000.0


def received(places, strength=1.0):
    """Intensities (P, 9) of exact inverse-square decays."""
    random = np.random.default_rng(0)
    a, b = 1e-3 * np.exp(0.3 * random.standard_normal((2, 9)))
    squared = np.sum((np.atleast_2d(places)[:, None] - MICROPHONES) ** 2, axis=-1)
    return a / (squared + b) * np.reshape(strength, (-1, 1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of taps and recordings, as intensities and as samples."""
    folder = tmp_path_factory.mktemp("locate")
    random = np.random.default_rng(1)
    places = grid(0.16, 0.16, 5, 5)
    geometry = {"microphones": MICROPHONES, "outline": OUTLINE, "positions": places}
    np.savez(folder / "taps.npz", **geometry, intensity=received(places, np.exp(random.standard_normal(25))))
    times = 0.05 * np.arange(40)
    path = np.stack([0.07 * np.cos(3 * times), 0.06 * np.sin(3 * times)], axis=1)
    intensity = received(path)
    intensity[25:] = 0
    np.savez(folder / "recording.npz", intensity=intensity, times=times)
    np.save(folder / "path.npy", path)
    # Noise of a touch in the second half of each recording, and weak noise of the microphones throughout.
    burst = np.r_[np.zeros(800), np.ones(800)]

    def sound(place):
        common = random.standard_normal(1600) * burst
        return np.sqrt(received(place)[0])[:, None] * common + 0.01 * random.standard_normal((9, 1600))

    np.savez(folder / "sounds.npz", **geometry, samples=np.stack([sound(place) for place in places]), rate=RATE)
    touch = sound([0.03, 0.02])
    np.savez(folder / "touch.npz", samples=touch, rate=RATE)
    scaled = touch / np.abs(touch).max() * 0.9
    wavfile.write(folder / "touch.wav", int(RATE), (32767 * scaled.T).astype(np.int16))
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["calibrate-microphones", str(folder / "taps.npz"), "--output", str(folder / "cal.json")]) == 0
    (folder / "cal.txt").write_text(printed.getvalue(), "utf-8")
    return folder


@pytest.fixture(scope="module")
def sounded(folder):
    """The same folder, with a calibration from samples."""
    command = ["calibrate-microphones", str(folder / "sounds.npz"), "-o", str(folder / "sound.json"), "-q"]
    assert main([*command, "--decay", "inverse-square"]) == 0
    return folder


def rows(folder):
    with open(folder / "track.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def off(folder, tmp_path_factory):
    """Taps whose intensities have errors of a third."""
    random = np.random.default_rng(3)
    with np.load(folder / "taps.npz") as file:
        taps = {name: file[name] for name in file.files}
    uneven = taps.pop("intensity") * np.exp(0.33 * random.normal(size=(25, 9)))
    path = tmp_path_factory.mktemp("off") / "off.npz"
    np.savez(path, **taps, intensity=uneven)
    return path


def test_the_printed_table_gives_the_parameters_of_each_microphone_with_their_units(folder):
    printed = (folder / "cal.txt").read_text("utf-8")
    title, *lines = printed[printed.index("  a / ") :].splitlines()[:10]
    ending = ["moved / mm", "error %", "explained %"]
    assert re.split(" {2,}", title.strip()) == ["a / m²", "± %", "b / mm²", "± %", *ending]
    table = np.array([line.split() for line in lines], float)
    calibration = Calibration.load(folder / "cal.json")
    decay = calibration.microphone_array.decay
    np.testing.assert_allclose(table[:, [1, 3]], np.stack([decay.a, 1e6 * decay.b], axis=1), rtol=6e-3)
    np.testing.assert_allclose(table[:, [2, 4]], 100 * calibration.standard_errors.T, atol=0.06)
    summary = " ".join((folder / "cal.txt").read_text("utf-8").split())
    (model_error,), (location_error,) = (
        re.findall(pattern, summary) for pattern in (r"error of the model (\S+) %", r"error of location ± (\S+) mm")
    )
    relative = calibration.microphone_array.noise.relative
    assert float(model_error) == pytest.approx(100 * np.median(relative), abs=0.06)
    assert float(location_error) < 0.2
    assert "locates taps left out of the fit to 0.0 mm, median (" in summary
    # A calibration with an exponential, an unknown standard error, and a microphone that is not usable.
    array = SimpleNamespace(
        decay=Exponential(np.array([0.5, 2.0]), np.array([0.03, 0.04])),
        noise=SimpleNamespace(relative=np.array([0.02, 0.3])),
    )
    fit = SimpleNamespace(
        calibration=SimpleNamespace(
            microphone_array=array, reasons=("", "dead"), standard_errors=np.array([[0.01, 0.1], [np.nan, 0.1]])
        ),
        displacement=np.array([[0.003, 0.004], [0.0, 0.0]]),
        explained=np.array([0.875, 0.0]),
    )
    columns = [(column.header, *column.cells) for column in _parameter_table(fit).columns]
    assert columns == [
        *(("", "0"), ("a / 1", "0.5"), ("± %", "1.0"), ("length / mm", "30"), ("± %", "–")),
        *zip(ending, ("5.0", "2.0", "87.5"), strict=True),
    ]


@pytest.mark.slow
def test_large_model_errors_are_noted(folder, off, tmp_path, capsys):
    """Intensities with errors of a third; the report of every calibration states the resulting error of location."""
    printed = {"exact": " ".join((folder / "cal.txt").read_text("utf-8").split())}
    assert main(["calibrate-microphones", str(off), "--output", str(tmp_path / "off.json")]) == 0
    printed["off"] = " ".join(capsys.readouterr().out.split())
    assert "the models miss" not in printed["exact"]
    assert re.search(
        r"decay model inverse-square: locates taps left out of the fit to 0\.0 mm, median \(", printed["exact"]
    )
    assert "the models miss the recorded levels by" in printed["off"]
    assert "in another way here than in any decay model." in printed["off"]
    exact, miss = (float(re.search(r"error of location ± ([\d.]+) mm", one)[1]) for one in printed.values())
    assert exact < 0.2
    assert miss > 2


@pytest.mark.slow
def test_another_decay_model_is_suggested_where_one_was_given(folder, off, tmp_path, capsys):
    """Intensities with errors of a third. For exact intensities the report names the best decay model and no errors."""
    assert main(["calibrate-microphones", str(off), "-o", str(tmp_path / "one.json"), "--decay", "exponential"]) == 0
    uneven, exact = (
        " ".join(one.split()) for one in (capsys.readouterr().out, (folder / "cal.txt").read_text("utf-8"))
    )
    assert "the models miss the recorded levels by" in uneven
    assert "try another --decay, or auto." in uneven
    assert "the models miss" not in exact
    assert re.search(r"decay model inverse-square: locates taps left out of the fit to 0\.0 mm, median \(", exact)
    small, large = (float(re.search(r"error of location ± ([\d.]+) mm", one)[1]) for one in (exact, uneven))
    assert small < 0.2
    assert large > 2


def test_locate_from_intensities(folder, tmp_path, capsys):
    """Exact intensities: positions to a micrometre, silent frames as "no touch", and all three files."""
    assert (folder / "cal.png").stat().st_size > 10_000
    status = main(
        ["locate", str(folder / "recording.npz"), "--calibration", str(folder / "cal.json"), "-o", str(tmp_path)]
    )
    assert status == 0
    table, path = rows(tmp_path), np.load(folder / "path.npy")
    columns = ["time_s", "x_m", "y_m", "std_x_m", "std_y_m", "covariance", "strength", "status"]
    assert list(table[0])[:8] == columns
    assert [row["status"] for row in table] == ["touch"] * 25 + ["no touch"] * 15
    found = np.array([[float(row["x_m"]), float(row["y_m"])] for row in table[:25]])
    assert np.abs(found - path[:25]).max() < 1e-6
    assert all(row["x_m"] == "" and row["strength"] == "" for row in table[25:])
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report["status"] == {"touch": 25, "no touch": 15}
    assert len(report["touches"]) == 1
    assert report["touches"][0]["offset_s"] == pytest.approx(1.2)
    assert (tmp_path / "track.png").stat().st_size > 10_000
    printed = " ".join(capsys.readouterr().out.split())
    assert "25 touch, 15 no touch" in printed
    # A stroke: from (70, 0) mm to the position 1.2 s later.
    assert f"1 0.000 1.200 70.0 → {70 * np.cos(3.6):.1f} 0.0 → {60 * np.sin(3.6):.1f}" in printed
    ((error, length),) = re.findall(r"→ \S+ \S+ → \S+ (\S+) (\S+) 25 touch", printed)
    assert 0 <= float(error) <= 0.05 + 1e3 * max(float(row["std_x_m"]) + float(row["std_y_m"]) for row in table[:25])
    assert float(length) == pytest.approx(1e3 * np.linalg.norm(np.diff(path[:25], axis=0), axis=1).sum(), rel=0.03)


def test_the_second_of_two_touches_has_its_own_line():
    """It is the touch farther from the track, in whichever order the two were found."""
    near, far = np.array([[10.0, 20, 0], [12, 20, 0]]) / 1e3, np.array([[-30.0, 5, 0], [-30, 7, 0]]) / 1e3
    locations = SimpleNamespace(
        times=[0.5, 0.75],
        status=np.array(2 * [LocationStatus.TWO_TOUCHES]),
        position=np.stack([near[0], far[1]]),
        second=np.stack([far[0], near[1]]),
    )
    touch = SimpleNamespace(first=0, last=1, onset=0.5, offset=0.75, length=0.002)
    track = SimpleNamespace(touches=[touch], position=near, covariance=np.tile(4e-6 * np.eye(2), (2, 1, 1)))
    assert list(_table_rows(SimpleNamespace(locations=locations, track=track))) == [
        ("1", "0.500", "0.750", "11.0", "20.0", "2.0", "2", "2 two touches"),
        ("1, other", "0.500", "0.750", "-30.0", "6.0", "", "", "2 two touches"),
    ]


@pytest.mark.parametrize("name", ["touch.npz", "touch.wav"])
def test_locate_from_samples(name, sounded, tmp_path):
    """A burst of noise is located within five standard deviations and a centimetre, from its onset on."""
    assert main(["locate", str(sounded / name), "-c", str(sounded / "sound.json"), "-o", str(tmp_path), "-q"]) == 0
    table = [row for row in rows(tmp_path) if row["x_m"]]
    assert table
    # The window must reach into the burst, which begins at 0.2 s.
    assert 0.17 < float(table[0]["time_s"]) < 0.24
    late = [row for row in table if float(row["time_s"]) > 0.25]
    for axis, truth in (("x", 0.03), ("y", 0.02)):
        off = np.array([float(row[f"{axis}_m"]) - truth for row in late])
        assert np.abs(off).max() < 0.01
        assert (np.abs(off) < 5 * np.array([float(row[f"std_{axis}_m"]) for row in late])).all()


@pytest.mark.slow
def test_python_functions_give_the_same_results(folder, tmp_path):
    """The same calibration, table and report as the commands write; only the picture's compression may differ."""
    fit = calibrate_microphones(read_taps(folder / "taps.npz"))
    write_calibration(fit, tmp_path / "made" / "cal.json")
    assert (tmp_path / "made" / "cal.json").read_text("utf-8") == (folder / "cal.json").read_text("utf-8")
    assert (tmp_path / "made" / "cal.png").stat().st_size > 10_000
    steps = []
    found = locate_touches(read_recording(folder / "recording.npz"), fit.calibration, progress=steps.append)
    assert steps == ["measure intensities", "locate", "track"]
    write_track(found, tmp_path / "python")
    assert (
        main(["locate", str(folder / "recording.npz"), "-c", str(folder / "cal.json"), "-o", str(tmp_path), "-q"]) == 0
    )
    assert rows(tmp_path / "python") == rows(tmp_path)
    reports = [json.loads((place / "report.json").read_text("utf-8")) for place in (tmp_path / "python", tmp_path)]
    assert reports[0] == reports[1]


def test_python_functions_refuse_invalid_options(folder):
    """Gaps that are too short, and sample settings for recordings of intensities."""
    recording, known = read_recording(folder / "recording.npz"), Calibration.load(folder / "cal.json")
    for options, message in (({"gap": 0.0}, "gap must be"), ({"gap": 0.01}, "gap: frames are 0.05 s apart")):
        with pytest.raises(ValueError, match=message):
            locate_touches(recording, known, **options)
    with pytest.raises(ValueError, match="intensity: band and window are for samples"):
        locate_touches(recording, known, intensity=IntensitySettings())
    with pytest.raises(ValueError, match="intensity: band and window are for taps"):
        calibrate_microphones(read_taps(folder / "taps.npz"), intensity=IntensitySettings())


def test_intensities_of_samples_are_smoothed_alike(sounded, tmp_path):
    """Intensities written to a file with their overlap give the same track with the same uncertainty."""
    measured = calibrated_intensities(read_recording(sounded / "touch.npz"), Calibration.load(sounded / "sound.json"))
    assert measured.overlap == 4
    write_recording(tmp_path / "intensities.npz", measured)
    for name, output in ((sounded / "touch.npz", "samples"), (tmp_path / "intensities.npz", "intensities")):
        command = ["locate", str(name), "-c", str(sounded / "sound.json"), "-o", str(tmp_path / output), "-q"]
        assert main(command) == 0
    assert rows(tmp_path / "samples") == rows(tmp_path / "intensities")


@pytest.mark.slow
def test_two_touches_are_both_printed(folder, tmp_path, capsys):
    """The second touch is beside the first, and stronger for a moment."""
    places = np.array([[0.05, 0.04], [-0.04, -2e-5]])
    first, second = received(places)
    share = np.where(np.isin(np.arange(12), [4, 8]), 1.6, 0.6)[:, None]
    np.savez(tmp_path / "two.npz", intensity=first + share * second, times=0.05 * np.arange(12))
    command = ["locate", str(tmp_path / "two.npz"), "-c", str(folder / "cal.json"), "-o", str(tmp_path)]
    assert main(command) == 0
    table = capsys.readouterr().out
    (line,) = [line for line in table.splitlines() if "1, other" in line]
    assert " -40.0 0.0 " in " ".join(line.split())  # values that round to zero have no sign
    assert "12 two" in line


@pytest.mark.slow
def test_a_touch_without_pauses_needs_a_recording_of_silence(sounded, tmp_path, capsys):
    """Without a recording of silence the touch is taken for silence, which is reported; with one it is located."""
    random = np.random.default_rng(6)
    times = np.arange(4000) / RATE
    tones = np.sin(2 * np.pi * np.arange(100, 900, 20)[:, None] * times + random.uniform(0, 6, (40, 1))).sum(axis=0)
    shaken = np.sqrt(received([0.03, 0.02])[0])[:, None] * tones
    np.savez(tmp_path / "shaken.npz", samples=shaken + 0.01 * random.standard_normal((9, 4000)), rate=RATE)
    np.savez(tmp_path / "hush.npz", samples=0.01 * random.standard_normal((9, 4000)), rate=RATE)
    command = ["locate", str(tmp_path / "shaken.npz"), "-c", str(sounded / "sound.json"), "-o", str(tmp_path)]
    assert main(command) == 0
    assert {row["status"] for row in rows(tmp_path)} == {"no touch"}
    printed = " ".join(capsys.readouterr().out.split())
    assert "never pauses" in printed
    assert "untouched (--silence)" in printed
    assert "silence=" in json.loads((tmp_path / "report.json").read_text("utf-8"))["notes"][0]
    assert main([*command, "--silence", str(tmp_path / "hush.npz"), "-q"]) == 0
    found = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows(tmp_path)])
    assert np.abs(found - [0.03, 0.02]).max() < 0.003


@pytest.mark.slow
def test_consistency_method(folder, tmp_path):
    """`--method consistency` (the loss of Park et al. 2022) locates exact intensities too."""
    command = ["locate", str(folder / "recording.npz"), "-c", str(folder / "cal.json"), "-o", str(tmp_path), "-q"]
    assert main([*command, "--method", "consistency"]) == 0
    found = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows(tmp_path)[:25]])
    assert np.abs(found - np.load(folder / "path.npy")[:25]).max() < 1e-6


def test_a_silent_recording_is_no_error(sounded, tmp_path):
    """All frames are silent: a table of "no touch", a report and a picture."""
    np.savez(tmp_path / "noise.npz", samples=0.01 * np.random.default_rng(5).standard_normal((9, 4000)), rate=RATE)
    command = ["locate", str(tmp_path / "noise.npz"), "-c", str(sounded / "sound.json"), "-o", str(tmp_path), "-q"]
    assert main(command) == 0
    assert {row["status"] for row in rows(tmp_path)} == {"no touch"}
    assert json.loads((tmp_path / "report.json").read_text("utf-8"))["touches"] == []


@pytest.mark.slow
def test_exchanged_microphones_are_named(folder, tmp_path):
    """Two microphones exchanged since the calibration are named in the report's notes."""
    with np.load(folder / "recording.npz") as arrays:
        intensity, times = arrays["intensity"], arrays["times"]
    intensity[:, [2, 6]] = intensity[:, [6, 2]]
    np.savez(tmp_path / "swapped.npz", intensity=intensity, times=times)
    assert (
        main(["locate", str(tmp_path / "swapped.npz"), "-c", str(folder / "cal.json"), "-o", str(tmp_path), "-q"]) == 0
    )
    notes = " ".join(json.loads((tmp_path / "report.json").read_text("utf-8"))["notes"])
    assert "2 and 6" in notes


def _bad_files(folder):
    """Write invalid calibrations, taps and recordings."""
    text = (folder / "cal.json").read_text("utf-8")
    (folder / "version.json").write_text(text.replace('"version": 1', '"version": 7'))
    (folder / "unit.json").write_text(text.replace('"length": "m"', '"length": "mm"'))
    (folder / "cut.json").write_text(text[:500])
    np.savez(folder / "milliseconds.npz", intensity=np.ones((3, 9)), times=50.0 * np.arange(3))
    np.savez(folder / "few.npz", intensity=np.ones((3, 4)), times=0.05 * np.arange(3))
    dead = np.full((3, 9), np.nan)
    dead[:, :2] = 1.0
    np.savez(folder / "dead.npz", intensity=dead, times=0.05 * np.arange(3))
    with np.load(folder / "taps.npz") as arrays:
        taps = dict(arrays)
    np.savez(folder / "millimetres.npz", **{**taps, "microphones": 1e3 * taps["microphones"]})
    np.savez(
        folder / "two.npz", **{**taps, "microphones": taps["microphones"][:2], "intensity": taps["intensity"][:, :2]}
    )
    np.savez(folder / "deaf.npz", **{**taps, "intensity": np.ones((25, 9))})
    np.savez(
        folder / "three_taps.npz", **{**taps, "positions": taps["positions"][:3], "intensity": taps["intensity"][:3]}
    )
    (folder / "text.npz").write_text("not an archive")


LOCATE = ["locate", "recording.npz", "-c", "cal.json", "-o", "out"]
CALIBRATE = ["calibrate-microphones", "taps.npz", "-o", "new.json"]


def instead(command, **changes):
    """A command with some words replaced."""
    return [changes.get(word.replace(".", "_"), word) for word in command]


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (instead(LOCATE, cal_json="version.json"), "version 7"),
        (instead(LOCATE, cal_json="unit.json"), "mm"),
        (instead(LOCATE, cal_json="cut.json"), "no calibration"),
        (instead(LOCATE, cal_json="taps.npz"), "no calibration"),
        (instead(LOCATE, cal_json="missing.json"), "missing.json"),
        (instead(LOCATE, recording_npz="few.npz"), "has 4 microphones"),
        (instead(LOCATE, recording_npz="dead.npz"), "three are needed"),
        (instead(LOCATE, recording_npz="milliseconds.npz"), "times in seconds"),
        (instead(LOCATE, recording_npz="text.npz"), "neither an NPZ nor a sound"),
        (instead(LOCATE, recording_npz="sounds.npz"), "read_taps"),
        (instead(LOCATE, recording_npz="missing.wav"), "missing.wav"),
        ([*LOCATE, "--method", "magic"], "likelihood, consistency"),
        ([*LOCATE, "--gap", "0"], "--gap"),
        ([*LOCATE, "--low", "100"], "for samples"),
        ([*LOCATE, "--silence", "touch.npz"], "--silence applies to recordings of samples"),
        (["locate", "touch.npz", "-c", "sound.json", "-o", "out", "--silence", "recording.npz"], "must contain"),
        (["locate", "touch.npz", "-c", "sound.json", "-o", "out", "--silence", "none.npz"], "none.npz"),
        (["locate", "touch.npz", "-c", "sound.json", "-o", "out", "--high", "5000"], "2000"),
        (["locate", "touch.npz", "-c", "sound.json", "-o", "out", "--window", "-1"], "window"),
        (instead(LOCATE, out="cal.json"), "is a file"),
        (instead(CALIBRATE, taps_npz="millimetres.npz"), "metres"),
        (instead(CALIBRATE, taps_npz="two.npz"), "three are needed"),
        ([*instead(CALIBRATE, taps_npz="deaf.npz"), "--decay", "inverse-square"], "three are needed"),
        (instead(CALIBRATE, taps_npz="three_taps.npz"), "three are needed"),
        (instead(CALIBRATE, taps_npz="recording.npz"), "microphones"),
        (instead(CALIBRATE, taps_npz="text.npz"), "NPZ"),
        ([*CALIBRATE, "--decay", "magic"], "inverse-square"),
        ([*CALIBRATE, "--low", "10"], "samples"),
        (instead(CALIBRATE, new_json="new.png"), "JSON"),
        (instead(CALIBRATE, new_json="."), "folder"),
    ],
)
def test_bad_input_is_explained(command, expected, sounded, monkeypatch, capsys):
    """Exit status 1 and one line on standard error, without a traceback."""
    monkeypatch.chdir(sounded)
    if not (sounded / "version.json").exists():
        _bad_files(sounded)
    assert main(command) == 1
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert "should not have happened" not in error
