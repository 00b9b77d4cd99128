"""`jeit touch gestures` and `jeit touch watch`: training on a file, classification from files and from standard input.

The frames are those of a linear skin, whose touches are spots of higher conductivity: the commands are tested, not the
methods.
"""

import contextlib
import csv
import io
import json
import re
import signal
from types import SimpleNamespace

import numpy as np
import pytest
from gesture_skin import GESTURES, RATE, TOML, linear_gestures_and_stream

from jeit.cli import main
from jeit.data import GestureSet
from jeit.touch.commands.touch_watch import _describe_touch


@pytest.fixture(scope="module", autouse=True)
def coarse_images():
    """Image on a coarse mesh, for which the commands have no option."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jeit.imaging.stream_preparation.DEFAULT_STREAM_NUM_POINTS", 250)
        yield


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gestures")
    made, stream = linear_gestures_and_stream()
    made.write(folder / "gestures.npz")
    (folder / "skin.toml").write_text(TOML, "utf-8")
    np.savez(folder / "stream.npz", frames=stream.voltages, seconds=stream.seconds)
    np.savetxt(folder / "stream.csv", stream.voltages[: round(stream.onset[3] * RATE)], delimiter=",")
    np.savetxt(folder / "rest.csv", stream.voltages[:60], delimiter=",")
    (folder / "empty.csv").write_text("", "utf-8")
    np.savez(folder / "none.npz", frames=np.zeros((0, 48)), seconds=np.zeros(0))
    np.savez(folder / "fewer.npz", frames=stream.voltages[:, :40], seconds=stream.seconds)
    np.savez(folder / "falling.npz", frames=stream.voltages, seconds=stream.seconds[::-1])
    np.savez(folder / "short.npz", frames=stream.voltages, seconds=stream.seconds[:-1])
    np.savez(folder / "same.npz", frames=stream.voltages, seconds=0 * stream.seconds)
    np.savez(folder / "thousandths.npz", frames=stream.voltages, seconds=1e3 * stream.seconds)
    np.savez(folder / "millivolts.npz", frames=1e3 * stream.voltages, seconds=stream.seconds)
    np.savez(folder / "broken.npz", frames=np.full_like(stream.voltages, np.nan), seconds=stream.seconds)
    (folder / "bare.toml").write_text(TOML[TOML.index("[protocol]") :] + "number = 8\n", "utf-8")
    (folder / "text.npz").write_text("text", "utf-8")
    return folder, stream


@pytest.fixture(scope="module")
def learnt(files):
    """The folder that the command wrote, and what it printed."""
    folder, _ = files
    arguments = ("touch", "gestures", folder / "gestures.npz", "--skin", folder / "skin.toml", "-o", folder / "model")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main([*map(str, arguments), "--method", "nearest"]) == 0
    return folder / "model", printed.getvalue()


def test_contacts_of_a_recording_are_tracked_without_learning(files, run, tmp_path):
    """Three touches, of which the last is a stroke of 0.14 m along x."""
    folder, stream = files
    given = ("--skin", folder / "skin.toml", "--rate", RATE, "--output", tmp_path)
    status, output, error = run("touch", "contacts", folder / "stream.csv", *given)
    assert (status, error) == (0, "")
    assert "3 touches" in output
    report = json.loads((tmp_path / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert "with less than 40 % of the strongest change of the frame" in report["notes"][0]
    np.testing.assert_allclose([touch["onset"] for touch in report["touches"]], stream.onset[:3], atol=0.2)
    np.testing.assert_allclose([touch["offset"] for touch in report["touches"]], stream.offset[:3], atol=0.2)
    assert [touch["path_length"] > 0.05 for touch in report["touches"]] == [False, False, True]
    rows = list(csv.DictReader((tmp_path / "contacts.csv").read_text("utf-8").splitlines()))
    assert {row["touch"] for row in rows} - {""} == {str(touch["touch"]) for touch in report["touches"]}
    times = [int(row["frame"]) / RATE for row in rows]
    np.testing.assert_allclose([float(row["time_s"]) for row in rows], times, rtol=1e-5)
    assert (tmp_path / "contacts.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_contacts_do_not_depend_on_where_times_and_the_reference_are_stated(files, run, tmp_path):
    folder, stream = files
    given = ("--skin", folder / "skin.toml", "--reference", folder / "rest.csv", "--output", tmp_path, "--quiet")
    status, output, _ = run("touch", "contacts", folder / "stream.npz", *given)
    assert (status, output) == (0, "")
    touches = json.loads((tmp_path / "report.json").read_text("utf-8"))["touches"]
    np.testing.assert_allclose([touch["onset"] for touch in touches], stream.onset, atol=0.2)


def test_noise_has_no_contacts_and_too_few_untouched_frames_are_refused(files, run, tmp_path):
    folder, _ = files
    asked = ("touch", "contacts", folder / "rest.csv", "--skin", folder / "skin.toml", "--output", tmp_path)
    status, output, _ = run(*asked, "--rate", RATE)
    assert status == 0
    assert "60 frames: 0 touches" in output
    status, _, error = run(*asked, "--rate", RATE, "--untouched", 0.01)
    assert status == 1
    assert "--untouched: the first 0.01 s" in error
    skin = ("--skin", folder / "skin.toml", "--reference", folder / "rest.csv", "--output", tmp_path)
    status, _, error = run("touch", "contacts", folder / "broken.npz", *skin)
    assert status == 1
    assert "could be imaged" in error


@pytest.fixture(scope="module")
def model(learnt):
    return learnt[0]


def events(folder):
    return list(csv.DictReader((folder / "events.csv").read_text("utf-8").splitlines()))


def test_training_writes_a_model_and_a_report(learnt):
    folder, output = learnt
    assert "24, of 2 people" in output
    report = json.loads((folder / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    right, shares = report["held_out"]["right"], report["held_out"]["right_by_gesture"]
    each = ", ".join(f"{name} {100 * share:.0f}" for name, share in shares.items())
    assert f"right, held out {100 * right:.1f} % ({each})" in " ".join(output.split())
    assert report["reading"]["num_channels"] == 48
    assert {one["classifier"] for one in report["held_out"]["tried"]} == {"nearest on seven", "nearest on course"}
    assert (folder / "gestures.png").read_bytes().startswith(b"\x89PNG")


def test_gestures_in_a_file_are_classified(files, model, run):
    folder, stream = files
    status, output, error = run(
        *("touch", "watch", folder / "stream.npz", "--skin", folder / "skin.toml", "--gestures", model),
        *("--output", folder / "out"),
    )
    assert (status, error) == (0, "")
    detected = events(folder / "out")
    times = re.findall(r"named within (\S+) ms of the frame after \(median\), 99 % within (\S+) ms", output)
    assert [one["gesture"] for one in detected] == 2 * list(GESTURES)
    np.testing.assert_allclose([float(one["onset_s"]) for one in detected], stream.onset, atol=0.2)
    for one in detected:
        assert 0 < float(one["probability"]) <= 1
        assert abs(float(one["x_m"])) <= 0.16
        assert abs(float(one["y_m"])) <= 0.1
    paths = list(csv.DictReader((folder / "out" / "paths.csv").read_text("utf-8").splitlines()))
    assert {one["touch"] for one in paths} == {one["touch"] for one in detected}
    report = json.loads((folder / "out" / "report.json").read_text("utf-8"), parse_constant=pytest.fail)
    assert report["frames"] == len(stream.seconds)
    assert report["touches"] == len(detected)
    named_within = 1e3 * np.array([report["named_within_s"][share] for share in ("median", "99_percent")])
    np.testing.assert_allclose(np.array(times[0], float), named_within, atol=0.051)
    # A touch is classified before the result of its frame is complete: two times of one order, in milliseconds.
    assert 0.03 < np.median([float(one["latency_ms"]) for one in detected]) / named_within[0] < 30
    assert (folder / "out" / "timeline.png").read_bytes().startswith(b"\x89PNG")


def printed_touches(output):
    """Lines of the output that describe a touch, by its place."""
    return [line for line in output.splitlines() if line.endswith(") mm")]


def test_a_printed_touch_has_its_probability_and_the_place_of_its_strongest_change():
    course = SimpleNamespace(centroid=np.array([[0.0, 0.0], [0.012, -0.031]]), peak=np.array([1.0, 2.0]))
    touch = SimpleNamespace(course=course, onset=3.25, offset=4.0, cut_off=False)
    named = SimpleNamespace(touch=touch, unlike=False, gesture="stroke", probability=0.87, held=True)
    words = ["3.25", "s", "0.75", "s", "stroke", "87", "%,", "held", "(+12,", "-31)", "mm"]
    assert _describe_touch(named).split() == words


def test_a_table_with_a_given_rate_gives_the_same_labels(files, model, run, tmp_path):
    """A touch that lasts to the end of the file is listed, too."""
    folder, stream = files
    np.savetxt(folder / "cut.csv", stream.voltages[: round((stream.onset[2] + 0.4) * RATE)], delimiter=",")
    status, output, error = run(
        *("touch", "watch", folder / "cut.csv", "--skin", folder / "skin.toml", "--gestures", model),
        *("--rate", RATE, "--reference", folder / "rest.csv", "--output", tmp_path),
    )
    assert (status, error) == (0, "")
    assert [one["gesture"] for one in events(tmp_path)][:2] == list(GESTURES)[:2]
    printed = printed_touches(output)
    assert ["cut off" in line for line in printed] == [False, False, True]
    for line, one in zip(printed, events(tmp_path), strict=True):
        onset, offset, x, y = (float(one[name]) for name in ("onset_s", "offset_s", "x_m", "y_m"))
        numbers = re.match(r"([\d.]+) s +([\d.]+) s .*\(([-+]\d+), ([-+]\d+)\) mm", line.strip())
        given = [float(number) for number in numbers.groups()]
        np.testing.assert_allclose(given[:2], [onset, offset - onset], atol=0.006)
        np.testing.assert_allclose(given[2:], [1e3 * x, 1e3 * y], atol=0.51)


@pytest.mark.slow
def test_gestures_on_standard_input_are_classified(files, model, run, tmp_path, monkeypatch):
    folder, stream = files
    lines = "\n".join(" ".join(map(repr, map(float, row))) for row in stream.voltages[:420])
    monkeypatch.setattr("sys.stdin", io.StringIO(lines + "\nno numbers\n"))
    status, output, error = run(
        *("touch", "watch", "-", "--skin", folder / "skin.toml", "--gestures", model, "--output", tmp_path),
        *("--rate", RATE),
    )
    assert (status, error) == (0, "")
    assert "1 refused" in output
    assert len(events(tmp_path)) >= 2


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_results_are_written_after_a_signal(files, model, run, tmp_path, monkeypatch, number):
    """Touches are printed as they end, so not the last, which the signal cut off."""
    folder, stream = files
    num_frames = round((stream.onset[2] + 0.4) * RATE)

    def lines():
        yield from (" ".join(map(repr, map(float, row))) for row in stream.voltages[:num_frames])
        signal.raise_signal(number)

    monkeypatch.setattr("sys.stdin", lines())
    status, output, error = run(
        *("touch", "watch", "-", "--skin", folder / "skin.toml", "--gestures", model, "--output", tmp_path),
        *("--rate", RATE),
    )
    assert (status, error) == (143 if number == signal.SIGTERM else 0, "")
    assert f"{num_frames} frames" in output
    assert ["cut off" in line for line in printed_touches(output)] == [False, False]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "events.csv",
        "paths.csv",
        "report.json",
        "timeline.png",
    ]
    assert json.loads((tmp_path / "report.json").read_text("utf-8"))["touches"] == len(events(tmp_path)) == 3


@pytest.mark.parametrize(
    ("stream", "options", "message"),
    [
        ("empty.csv", {}, "holds no numbers"),
        ("none.npz", {}, "frames: there is none"),
        ("fewer.npz", {}, "of 48 channels"),
        ("falling.npz", {}, "seconds fall after frame 0"),
        ("short.npz", {}, "give seconds for each of"),
        ("same.npz", {}, "seconds are all 0: give when each frame came"),
        ("thousandths.npz", {}, "are these milliseconds?"),
        ("millivolts.npz", {}, "times the conductivity of that which gestures were learnt on"),
        ("broken.npz", {}, "--untouched: the first 1 s of 'broken.npz' have 0 frames with a reading"),
        ("text.npz", {}, "not an NPZ file"),
        ("missing.npz", {}, "there is no such file"),
        ("skin.toml", {}, "give frames as .csv"),
        ("stream.npz", {"--rate": "0"}, "--rate must be positive"),
        ("stream.npz", {"--untouched": "0"}, "--untouched must be positive"),
        ("stream.npz", {"--patience": "nan"}, "--patience must be positive"),
        ("stream.npz", {"--skin": "bare.toml"}, "images need [geometry], [electrodes] too"),
        ("stream.npz", {"--skin": "nowhere.toml"}, "there is no such file"),
        ("stream.npz", {"--gestures": "nowhere"}, "`jeit touch gestures` makes one"),
        ("stream.npz", {"--gestures": "stream.npz"}, "is not a gesture model"),
        ("stream.npz", {"--untouched": "0.01"}, "--untouched: the first 0.01 s"),
    ],
)
def test_invalid_input_is_reported(files, model, run, tmp_path, stream, options, message):
    folder, _ = files
    given = {"--skin": "skin.toml", "--gestures": "model", "--output": tmp_path / "out"} | options
    words = [
        word
        for name, value in given.items()
        for word in (name, folder / value if name in ("--skin", "--gestures") else value)
    ]
    status, _, error = run("touch", "watch", folder / stream, *words)
    assert status == 1
    assert message in error
    assert len(error) < 400
    assert not (tmp_path / "out" / "events.csv").exists()


def test_invalid_recordings_are_reported(files, run, tmp_path):
    folder, _ = files
    made = GestureSet.read(folder / "gestures.npz")
    skin = ("--skin", folder / "skin.toml", "--output", tmp_path / "out")
    np.savez(tmp_path / "few.npz", **{**vars(made), "gesture": np.full(len(made), "tap")})
    assert "two gestures, or more" in run("touch", "gestures", tmp_path / "few.npz", *skin)[2]
    np.savez(tmp_path / "odd.npz", gesture=made.gesture)
    assert "odd.npz': there is no array 'start'" in run("touch", "gestures", tmp_path / "odd.npz", *skin)[2]
    status, _, error = run("touch", "gestures", folder / "gestures.npz", *skin, "--method", "oracle")
    assert (status, "--method must be one of" in error) == (1, True)
