"""`jeit listen` and `jeit listen fit`: a model from clips, labels and positions of a recording, and every invalid
file."""

import csv
import json

import jax
import numpy as np
import pytest
from scipy.io import wavfile

from jeit.acoustic import Calibration, Recording, calibrate_microphones, read_recording, write_recording
from jeit.acoustic.signal.recording import Taps
from jeit.acoustic.simulate import (
    SoundingSkin,
    microphone_grid,
    simulate_calibration_taps,
    simulate_pat,
    simulate_silence,
)
from jeit.cli import main
from jeit.cli.console import plain_console
from jeit.touch.commands.listen import _print_summary
from jeit.touch.listening import Listener, SoundLabels, read_clips

RATE = 16_000


def sounds(random: np.random.Generator, pitch: float, seconds: float = 0.3) -> np.ndarray:
    times = np.arange(round(seconds * RATE)) / RATE
    ring = np.sin(2 * np.pi * pitch * (1 + 0.03 * random.standard_normal()) * times) * np.exp(-times / 0.05)
    return 0.3 * 10 ** (0.1 * random.standard_normal()) * ring + 1e-3 * random.standard_normal(len(times))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Clips of two classes in every WAV format, one of them broken, and a model trained on them."""
    folder, random = tmp_path_factory.mktemp("listen"), np.random.default_rng(0)
    kinds = (np.int16, np.int32, np.uint8, np.float32, np.float64)
    for name, pitch in (("low", 400.0), ("high", 3000.0)):
        (folder / "clips" / name).mkdir(parents=True)
        for number, kind in enumerate(kinds):
            samples = sounds(random, pitch)
            if kind == np.uint8:
                samples = np.round(128 + 127 * samples)
            elif np.issubdtype(kind, np.integer):
                samples = np.round(np.iinfo(kind).max * samples)
            wavfile.write(folder / "clips" / name / f"{number}.wav", RATE, samples.astype(kind))
    (folder / "clips" / "low" / "notes.wav").write_text("text that is named as sound is", "utf-8")
    wavfile.write(folder / "clips" / "low" / "nan.wav", RATE, np.full(9000, np.nan, np.float32))
    wavfile.write(folder / "clips" / "low" / "slow.wav", 800, np.ones(9000, np.float32))
    (folder / "clips" / "low" / ".DS_Store").write_text("hidden", "utf-8")
    command = ["listen", "fit", str(folder / "clips"), "--output", str(folder / "model"), "--method", "trees"]
    assert main(command) == 0
    wavfile.write(folder / "one.wav", RATE, sounds(random, 400.0).astype(np.float32))
    return folder


def test_fit_writes_a_model_and_its_accuracy(folder):
    assert sorted(one.name for one in (folder / "model").iterdir()) == ["learning.png", "listener.jeit", "report.json"]
    report = json.loads((folder / "model" / "report.json").read_text("utf-8"))
    assert report["classes"] == ["high", "low"]
    assert report["held_out"]["clips"] == 10
    assert report["held_out"]["right"] > 0.8
    assert report["held_out"]["tried"] == [{"method": "trees", "right": report["held_out"]["right"]}]
    assert report["notes"][0].startswith("3 files not read: nan.wav: none of its samples is a number; notes.wav:")
    assert "slow.wav: 800 samples a second are too few" in report["notes"][0]
    assert (folder / "model" / "learning.png").stat().st_size > 10_000


def test_probabilities_are_limited_by_the_number_of_clips(folder):
    """Ten clips classified correctly: the next is correct with probability 11/12, plus half of the rest. Silence has no
    label."""
    listener = Listener.read(folder / "model")
    assert listener.doubt == pytest.approx(1 / 12)
    labels = listener.classify(read_recording(folder / "one.wav"))
    assert labels.probabilities.max() <= 1 - 1 / 24 + 1e-9
    np.testing.assert_allclose(labels.probabilities.sum(axis=1), 1)
    hush = listener.classify(Recording(1e-9 * np.random.default_rng(0).normal(size=(1, RATE)), RATE))
    assert hush.whole == ("", 0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--output", "CLIPS/model"), "lies in the folder of clips"),
        (("--output", "model", "--method", "linear", "--batches", "10"), "--batches applies to networks"),
    ],
)
def test_refused_options_leave_no_files(folder, tmp_path, capsys, options, message):
    """The error comes before any computation."""
    clips = folder / "clips"
    options = [one.replace("CLIPS", str(clips)).replace("model", str(tmp_path / "model")) for one in options]
    options = [str(clips / "model") if one.startswith(str(clips)) else one for one in options]
    assert main(["listen", "fit", str(clips), *options]) == 1
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (clips / "model").exists()
    assert not (tmp_path / "model").exists()


def test_names_are_printed_without_markup(folder, tmp_path, capsys):
    """Square brackets in a name are printed as they are."""
    output = tmp_path / "out [bold]x[/bold]"
    command = ["listen", str(folder / "one.wav"), "--model", str(folder / "model"), "--output", str(output)]
    assert main(command) == 0
    assert "out [bold]x[/bold]" in capsys.readouterr().out


def test_files_without_a_class_and_silent_clips_are_noted(tmp_path):
    random = np.random.default_rng(0)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        wavfile.write(tmp_path / name / "1.wav", RATE, sounds(random, 400.0).astype(np.float32))
    wavfile.write(tmp_path / "a" / "still.wav", RATE, np.zeros(RATE, np.float32))
    wavfile.write(tmp_path / "c.wav", RATE, np.zeros(RATE, np.float32))
    notes = " ".join(read_clips(tmp_path).notes)
    assert "still.wav: it is silent" in notes
    assert "1 file of no class, beside their folders, left out ('c.wav')" in notes


def test_a_recording_is_classified(folder, tmp_path, capsys):
    """Options may come before the recording, and the model may be given as its file."""
    model = folder / "model" / "listener.jeit"
    assert main(["listen", "--model", str(model), "--output", str(tmp_path), str(folder / "one.wav")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "as a whole low" in printed
    with open(tmp_path / "events.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["time_s", "sound", "probability", "p_high", "p_low", "microphone"]
    assert float(rows[0]["p_high"]) + float(rows[0]["p_low"]) == pytest.approx(1, abs=1e-5)
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert report["whole"]["sound"] == "low"
    assert len(rows) == report["windows"]
    assert (tmp_path / "timeline.png").stat().st_size > 5_000
    labels = Listener.read(model).classify(read_recording(folder / "one.wav"))
    assert [row["sound"] for row in rows] == labels.named.tolist()


def test_printed_sounds_have_seconds_per_cent_and_millimetres(capsys):
    """The last sound has no place. The whole recording has the geometric mean of the probabilities."""
    probabilities = np.array([[0.9, 0.1], [0.9, 0.1], [0.2, 0.8]])
    no, yes, place = np.zeros(3, bool), np.ones(3, bool), np.array([[0.01, -0.02], [0.02, -0.02], [np.nan, np.nan]])
    of_windows = {"quiet": no, "known": yes, "strongest": np.zeros(3, int), "loud": yes, "position": place}
    labels = SoundLabels(np.array([1.0, 1.1, 1.2]), probabilities, ("low", "high"), **of_windows)
    _print_summary(plain_console(), labels)
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line]
    assert ["as", "a", "whole", "low,", "73", "%"] in lines
    assert " ".join(lines[-3]) == "sound from / s to / s sure / % x / mm y / mm"
    assert (lines[-2][:1], lines[-2][2:]) == (["low"], ["1.15", "90", "15.0", "-20.0"])
    assert (lines[-1][:2], lines[-1][3:]) == (["high", "1.15"], ["80"])


def test_folders_within_a_class_are_held_out_together(folder, tmp_path):
    for name in ("low", "high"):
        for number, person in enumerate(("ann", "ann", "bob", "bob")):
            (tmp_path / name / person).mkdir(parents=True, exist_ok=True)
            read = (folder / "clips" / name / f"{number}.wav").read_bytes()
            (tmp_path / name / person / f"{number}.wav").write_bytes(read)
    clips = read_clips(tmp_path)
    assert sorted(set(clips.groups)) == ["ann", "bob"]
    assert (clips.groups == "ann").sum() == 4


@pytest.mark.slow
def test_sounds_are_located_with_a_calibration(tmp_path):
    """Pats on a simulated skin are classified, and located to a centimetre."""
    skin = SoundingSkin(jax.random.key(0), microphone_grid(3))
    outline = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
    taps = simulate_calibration_taps(skin, jax.random.key(1), microphone_grid(7))
    fit = calibrate_microphones(
        Taps(np.asarray(skin.microphones), outline, taps.positions, samples=taps.samples, rate=taps.rate)
    )
    fit.calibration.save(tmp_path / "skin.json")
    assert isinstance(Calibration.load(tmp_path / "skin.json"), Calibration)
    for number in range(3):
        for name, made in (
            ("pat", simulate_pat(skin, jax.random.key(10 + number), (0.01 * number, 0.02), duration=1.5)),
            ("none", simulate_silence(skin, jax.random.key(20 + number), duration=1.5)),
        ):
            (tmp_path / "clips" / name).mkdir(parents=True, exist_ok=True)
            write_recording(tmp_path / "clips" / name / f"{number}.npz", Recording(made.samples, made.rate))
    model = str(tmp_path / "model")
    assert main(["listen", "fit", str(tmp_path / "clips"), "-o", model, "--method", "linear", "-q"]) == 0
    recorded = simulate_pat(skin, jax.random.key(30), (-0.03, 0.04), duration=1.5)
    write_recording(tmp_path / "pat.npz", Recording(recorded.samples, recorded.rate))
    command = ["listen", str(tmp_path / "pat.npz"), "-m", model, "-o", str(tmp_path / "out"), "-q"]
    assert main([*command, "-c", str(tmp_path / "skin.json")]) == 0
    with open(tmp_path / "out" / "events.csv", encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["x_m"]]
    assert len(rows) >= 2
    assert {row["sound"] for row in rows} == {"pat"}
    found = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows])
    assert np.abs(found - [-0.03, 0.04]).max() < 0.01


def test_help_shows_the_usage(capsys):
    for command in (["listen"], ["listen", "--help"]):
        assert main(command) == 0
        printed = capsys.readouterr().out
        assert "Usage: jeit listen [OPTIONS]" in printed
        assert "jeit listen fit" in " ".join(printed.split())
    assert main(["listen", "fit", "--help"]) == 0
    assert "Usage: jeit listen fit [OPTIONS]" in capsys.readouterr().out


def _bad(folder) -> None:
    """Write invalid recordings and folders."""
    loud = sounds(np.random.default_rng(1), 400.0)
    wavfile.write(folder / "empty.wav", RATE, np.zeros(0, np.int16))
    wavfile.write(folder / "stereo_sample.wav", RATE, np.zeros((1, 2), np.int16))
    wavfile.write(folder / "eight.wav", 8000, loud.astype(np.float32))
    (folder / "text.wav").write_text("text", "utf-8")
    (folder / "cut.wav").write_bytes((folder / "one.wav").read_bytes()[:2000])
    (folder / "sound.flac").write_bytes(b"fLaC and no more")
    np.savez(folder / "intensities.npz", intensity=np.ones((3, 4)), times=0.05 * np.arange(3))
    (folder / "lonely" / "low").mkdir(parents=True)
    (folder / "hollow" / "low").mkdir(parents=True)
    (folder / "hollow" / "high").mkdir()
    (folder / "hollow" / "low" / "1.wav").write_bytes((folder / "one.wav").read_bytes())
    (folder / "files").mkdir()
    (folder / "files" / "1.wav").write_bytes((folder / "one.wav").read_bytes())


@pytest.mark.parametrize(
    ("command", "message"),
    [
        *(
            (["listen", name, "-m", "model", "-o", "out"], message)
            for name, message in (
                ("empty.wav", "empty"),
                ("stereo_sample.wav", "looks transposed"),
                ("eight.wav", "has 8000 samples a second"),
                ("text.wav", "neither an NPZ nor a sound"),
                ("cut.wav", "cut off"),
                ("sound.flac", "soundfile"),
                ("intensities.npz", "holds intensities"),
                ("missing.wav", "missing.wav"),
            )
        ),
        (["listen", "one.wav", "-m", "clips", "-o", "out"], "jeit listen fit"),
        (["listen", "one.wav", "-m", "one.wav", "-o", "out"], "another kind"),
        (["listen", "one.wav", "-m", "model", "-o", "one.wav"], "is a file"),
        (["listen", "one.wav", "-m", "model", "-o", "out", "-c", "one.wav"], "one.wav"),
        (["listen", "fit", "lonely", "-o", "new"], "only 'low'"),
        (["listen", "fit", "files", "-o", "new"], "it has none"),
        (["listen", "fit", "hollow", "-o", "new"], "it is empty"),
        (["listen", "fit", "missing", "-o", "new"], "is no folder"),
        (["listen", "fit", "clips", "-o", "new", "--method", "magic"], "--method"),
        (["listen", "fit", "clips", "-o", "new", "--batches", "0"], "--batches"),
        (["listen", "fit", "clips", "-o", "new", "--loudness", "loud"], "--loudness must be one of auto, counts"),
    ],
)
def test_bad_input_is_explained(command, message, folder, monkeypatch, capsys):
    """Exit status 1 and one line on standard error, without a traceback."""
    monkeypatch.chdir(folder)
    if not (folder / "text.wav").exists():
        _bad(folder)
    assert main(command) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert "should not have happened" not in error


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["listen", "one.wav"], "Missing option '--model' / '-m'. See 'jeit listen --help'"),
        (["listen", "fit"], "Missing argument 'FOLDER-BY-CLASS'. See 'jeit listen fit --help'"),
        (["listen", "one.wav", "two.wav", "-m", "model", "-o", "out"], "two.wav"),
        (["listen", "one.wav", "--modle", "model"], "--modle"),
    ],
)
def test_usage_errors_are_explained(command, message, capsys):
    assert main(command) == 2
    assert message in capsys.readouterr().err


def test_unusual_recordings_are_classified(folder, tmp_path, capsys):
    """One sample, silence, NaN, two channels, another rate: a label or "quiet", and never a traceback."""
    loud = sounds(np.random.default_rng(2), 400.0, seconds=1.0)
    holed = loud.copy()
    holed[100:4000] = np.nan
    odd = {
        "one": loud[:1],
        "silent": np.zeros(RATE),
        "holed": holed,
        "nothing": np.full(RATE, np.nan),
        "stereo": np.stack([loud, loud], axis=1),
    }
    for name, samples in odd.items():
        wavfile.write(tmp_path / f"{name}.wav", RATE, samples.astype(np.float32))
        command = ["listen", str(tmp_path / f"{name}.wav"), "-m", str(folder / "model"), "-o", str(tmp_path / name)]
        assert main(command) == 0, name
        report = json.loads((tmp_path / name / "report.json").read_text("utf-8"))
        assert report["windows"] >= 1
        if name in ("silent", "nothing"):
            assert report["whole"]["sound"] is None
            assert report["windows_of_each"] == {"quiet": report["windows"]}
        if name in ("holed", "stereo"):
            assert report["whole"]["sound"] == "low"
            assert report["notes"]
    capsys.readouterr()
    wavfile.write(tmp_path / "fast.wav", 48_000, np.repeat(loud, 3).astype(np.float32))
    assert main(["listen", str(tmp_path / "fast.wav"), "-m", str(folder / "model"), "-o", str(tmp_path / "fast")]) == 0
