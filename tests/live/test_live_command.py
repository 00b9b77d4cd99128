"""`jeit live` and `jeit.live.prepare`: the source and view that arguments select, and messages where something does not
fit.

The page itself is not served here.
"""

import json
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gesture_skin import RATE, TOML, linear_gestures_and_stream
from made_skins import record
from small_sensor import CHANNELS, description, measured, noisy, rest
from thread_limits import libraries_found_once

import jeit.live
from jeit.cli import main
from jeit.data import load_description, write_table
from jeit.imaging.stream_preparation import StreamSettings
from jeit.live.commands.live import _has_display, _print_counters
from jeit.touch import LearntSkin, Presses, learn_gestures, write_skin


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    monkeypatch.setattr("jeit.imaging.stream_preparation.DEFAULT_STREAM_NUM_POINTS", 250)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def served(monkeypatch):
    """The session that the command would serve, with its first results, in place of a server."""
    seen = SimpleNamespace(results=[], wanted=3)

    def serve(session, *, host, port, stay, opened):
        seen.session, seen.host, seen.port, seen.stay = session, host, port, stay
        opened("http://127.0.0.1:1/")
        last = -1
        while len(seen.results) < seen.wanted and (one := session.newest(last, 20.0)) is not None:
            seen.results.append(one)
            last = one.frame.number

    monkeypatch.setattr("jeit.live.server.serve", serve)
    return seen


@pytest.fixture
def run(capsys):
    def call(*arguments):
        status = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call


@pytest.fixture
def files(tmp_path):
    """A reference of the small sensor with its description, and frames of it without one."""
    write_table(measured(), tmp_path / "rest.npz")
    description(tmp_path / "sensor.toml")
    np.savetxt(tmp_path / "frames.csv", noisy(40, seed=3), delimiter=",")
    return tmp_path


@pytest.mark.slow
def test_the_demonstration_shows_the_rod(served, run):
    """Within 10 mm of its true place, in linear images."""
    status, output, error = run("live", "demo", "--method", "one-step", "--num-points", 800, "--no-browser")
    assert (status, error) == (0, "")
    assert "http://127.0.0.1:1/  (open it in a browser)" in output
    assert "latency" in output
    assert (served.host, served.port, served.stay) == ("127.0.0.1", 0, True)
    source = served.session.source
    for one in served.results:
        pixels, extent = one.picture.pixels, served.session.scene.extent
        row, column = np.unravel_index(np.nanargmin(pixels), pixels.shape)
        x = extent[0] + (extent[1] - extent[0]) * (column + 0.5) / pixels.shape[1]
        y = extent[3] - (extent[3] - extent[2]) * (row + 0.5) / pixels.shape[0]
        assert np.hypot(*np.subtract((x, y), source.truth(one.frame.second))) < 0.01
        (marker,) = one.picture.markers
        assert np.hypot(*np.subtract((marker.x, marker.y), source.truth(one.frame.second))) < 0.01


def test_a_file_is_played_against_its_reference(served, run, files):
    given = ("live", files / "frames.csv", "--reference", files / "rest.npz", "--rate", 500, "--until-end", "-q")
    status, output, error = run(*given, "--method", "one-step", "--port", 8765)
    assert (status, output, error) == (0, "  http://127.0.0.1:1/  (open it in a browser)\n", "")
    assert (served.port, served.stay) == (8765, False)
    assert [one.picture.status for one in served.results] == 3 * ["unchanged"]
    assert len(served.session.scene.channels) == CHANNELS


def test_without_an_image_the_status_says_so(served, run, files):
    np.savetxt(files / "short.csv", np.ones((3, 7)), delimiter=",")
    lines = (files / "short.csv").open()
    given = ("live", "-", "--reference", files / "rest.npz", "--rate", 500, "--until-end", "--method", "one-step")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", lines)
        status, _, error = run(*given)
    lines.close()
    assert (status, "3 frames, and none could be imaged: The frame has 7 numbers" in error) == (1, True)


def test_obstacles_are_found_before_anything_is_prepared(run, files, monkeypatch):
    monkeypatch.setattr("jeit.live.preparation.prepare", None)
    (files / "taken").write_text("")
    given = ("live", files / "frames.csv", "--reference", files / "rest.npz")
    status, _, error = run(*given, "--output", files / "taken" / "below")
    assert (status, "--output: no folder" in error, "is in the way" in error) == (1, True, True)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        status, _, error = run(*given, "--port", other.getsockname()[1])
    assert (status, "is taken or not allowed: choose another" in error) == (1, True)


def test_the_first_frames_are_the_reference(served, run, files, monkeypatch):
    """From lines on standard input with a description. Lines that are no frames are left out."""
    lines = "\n".join(" ".join(map(repr, row)) for row in noisy(60).tolist())
    changed = " ".join(map(repr, (1.02 * rest()).tolist()))
    (files / "lines.txt").write_text(f"starting\n{lines}\n{changed}\n", "utf-8")
    stdin = (files / "lines.txt").open()
    monkeypatch.setattr(sys, "stdin", stdin)
    ready = []
    monkeypatch.setattr("jeit.live.preparation.first_frames", _kept(ready))
    given = ("live", "-", "--description", files / "sensor.toml", "--rate", 100, "--untouched", 0.3)
    status, _, error = run(*given, "--method", "one-step", "--quiet", "--output", files / "out", "--record")
    assert (status, error) == (0, "")
    stdin.close()
    (still,) = ready
    np.testing.assert_array_equal(still, noisy(60)[:30])
    (folder,) = (files / "out").iterdir()
    assert {"frames.csv", "reference.npz"} <= {one.name for one in folder.iterdir()}


def _kept(frames):
    original = jeit.live.preparation.first_frames

    def first_frames(source, seconds, report, rate=None):
        still, following = original(source, seconds, report, rate=rate)
        frames.append(still)
        return still, following

    return first_frames


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("-",), "--reference is missing"),
        (("nowhere.csv", "--description", "sensor.toml"), "SOURCE: there is no file or folder 'nowhere.csv'"),
        (("demo:pond",), "must be one of tank, skin"),
        (("demo", "--rate", 0), "--rate must be positive"),
        (("demo", "--method", "two-step"), "--method"),
        (("demo", "--memory", -1), "--memory must be"),
        (("demo", "--model", "sensor.toml", "--method", "one-step"), "--method has no use with --model"),
        (("demo", "--calibration", "sensor.toml", "--contacts"), "--contacts has no use with --calibration"),
        (("demo", "--model", "."), "--model: '.' is neither a folder of 'jeit touch fit'"),
        (("demo", "--model", "sensor.toml"), "--model: 'sensor.toml' is neither"),
        (("demo", "--model", ".", "--calibration", "sensor.toml"), "different sensors"),
        (("frames.csv", "--description", "sensor.toml", "--untouched", 0.001), "--untouched: the first 0.001 s have"),
        (("frames.csv", "--reference", "none.npz"), "none.npz"),
    ],
)
def test_messages_about_arguments_that_do_not_fit(served, run, files, monkeypatch, given, message):
    monkeypatch.chdir(files)
    status, _, error = run("live", *given, "--quiet", "--no-browser")
    assert status == 1
    assert error.count("\n") == 1
    assert message in error
    assert not served.results


def test_a_recording_is_played_from_its_beginning(files):
    """The frames of its first tenth of a second are the reference as well."""
    settings = StreamSettings(solver="one-step")
    given = {"description": files / "sensor.toml", "rate": 200.0, "untouched": 0.1, "settings": settings}
    ready = jeit.live.prepare(str(files / "frames.csv"), **given)
    np.testing.assert_allclose(ready.reference.filled()[0], noisy(40, seed=3)[:21].mean(axis=0))
    frames = [frame.values for frame in ready.source]
    np.testing.assert_array_equal(frames, noisy(40, seed=3))


@pytest.mark.slow
def test_contacts_are_shown_on_request(served, run):
    assert run("live", "demo", "--contacts", "--method", "one-step", "-q")[0] == 0
    assert served.session.scene.title == "Contacts, Conductivity change, simulated tank"
    assert {one.picture.markers[0].track for one in served.results} == {0}


def test_a_learnt_skin_is_recognised_by_its_file(tmp_path):
    with libraries_found_once():
        given = record(60)
        skin = LearntSkin.fit(Presses.create(**given), method="neighbours")
    write_skin(skin, tmp_path / "skin.skops")
    later = record(10, seed=4)
    np.savez(tmp_path / "later.npz", frames=later["frames"], reference=later["reference"][0])
    np.savez(tmp_path / "rest.npz", frames=given["reference"][:5])
    for model, reference in ((tmp_path, None), (tmp_path / "skin.skops", tmp_path / "rest.npz")):
        ready = jeit.live.prepare(str(tmp_path / "later.npz"), reference, model=model, rate=1000.0)
        assert isinstance(ready.view, jeit.live.LearntSkinView)
        found = skin.predict(later["frames"], later["reference"][0])
        results = list(jeit.live.frames(ready.source, ready.view))
        assert results
        for one in results:
            (marker,) = one.picture.markers
            assert marker.x == pytest.approx(found.position[one.frame.number, 0])
    # Without a reference, the first frames are taken for it; a skin learnt without references needs none.
    np.savez(tmp_path / "both.npz", frames=np.vstack([given["reference"][:5], 1.1 * later["frames"]]))
    played = str(tmp_path / "both.npz")
    ready = jeit.live.prepare(played, model=tmp_path / "skin.skops", rate=1000.0, untouched=0.0045)
    np.testing.assert_allclose(ready.view.reference, given["reference"][0])
    (tmp_path / "absolute").mkdir()
    write_skin(replace(skin, mean_reference=None), tmp_path / "absolute" / "skin.skops")
    ready = jeit.live.prepare(played, model=tmp_path / "absolute", rate=1000.0, untouched=0.001)
    assert ready.view.reference is None
    (tmp_path / "network.jeit").write_bytes(b"")
    with pytest.raises(ValueError, match=r"holds skin\.skops and network\.jeit"):
        jeit.live.prepare("demo", model=tmp_path)


def test_gestures_need_a_description(tmp_path):
    made, stream = linear_gestures_and_stream()
    (tmp_path / "skin.toml").write_text(TOML, "utf-8")
    with libraries_found_once():
        described = load_description(tmp_path / "skin.toml")
        learn_gestures(described, made, method="nearest").model.write(tmp_path / "gestures.skops")
    end = round((stream.offset[0] + 0.5) * RATE)
    np.savez(tmp_path / "stream.npz", frames=stream.voltages[:end], seconds=stream.seconds[:end])
    given = {"model": tmp_path / "gestures.skops", "rate": RATE}
    with pytest.raises(ValueError, match="description is missing"):
        jeit.live.prepare(str(tmp_path / "stream.npz"), **given)
    ready = jeit.live.prepare(str(tmp_path / "stream.npz"), description=tmp_path / "skin.toml", **given, untouched=0.5)
    assert isinstance(ready.view, jeit.live.GestureView)
    reported = [text for one in jeit.live.frames(ready.source, ready.view) for text in one.picture.events]
    assert len(reported) == 1
    assert json.dumps(reported)


@pytest.mark.parametrize(
    ("variables", "shown"), [({}, False), ({"DISPLAY": ":0"}, True), ({"WAYLAND_DISPLAY": "wayland-0"}, True)]
)
def test_a_browser_opens_where_there_is_a_display(monkeypatch, served, run, files, variables, shown):
    opened = []
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr("webbrowser.open", opened.append)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert _has_display() == shown
    given = ("live", files / "frames.csv", "--reference", files / "rest.npz", "--method", "one-step", "--rate", 500)
    _, output, _ = run(*given)
    assert ("open it in a browser" in output) != shown
    assert opened == ["http://127.0.0.1:1/"] * shown


def test_latencies_are_printed_in_milliseconds():
    lines = []
    console = SimpleNamespace(print=lambda line, **options: lines.append(line.strip()))
    counts = {"read": 5, "imaged": 3, "dropped": 0, "refused": 2, "statuses": {"partial": 1}, "reasons": {"short": 2}}
    _print_counters(console, {**counts, "latency_median": 0.0123, "latency_99": 0.25})
    latencies = "latency to the picture: median 12.3 ms, 99 % within 250.0 ms"
    assert lines == ["5 frames: 3 imaged, 2 refused", latencies, "1 partial", "2 × short"]


def test_a_port_in_use_is_named(run, files):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        given = ("live", files / "frames.csv", "--reference", files / "rest.npz", "--method", "one-step", "--rate", 500)
        status, _, error = run(*given, "--port", port, "--quiet")
    assert status == 1
    assert f"port {port} is taken" in error
    assert error.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(("sent", "exits"), [(signal.SIGINT, 0), (signal.SIGTERM, 128 + signal.SIGTERM)])
def test_a_process_serves_the_page_until_it_is_stopped(tmp_path, sent, exits):
    """By Ctrl-C or SIGTERM. It prints its counters, and the recording contains every frame read."""
    command = [sys.executable, "-m", "jeit", "live", "demo", "--record", "--output", str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            address = next(found for line in process.stdout if (found := re.search(r"http://\S+", line)))[0]
            with urllib.request.urlopen(address, timeout=30) as page:
                assert b"jeit live" in page.read()
            process.send_signal(sent)
            rest = process.stdout.read()
            status = process.wait(30)
        finally:
            process.kill()
        assert (status, process.stderr.read()) == (exits, "")
    (folder,) = (tmp_path / "out").iterdir()
    recorded = len((folder / "frames.csv").read_text().splitlines()) - 1
    assert f"{recorded} frames:" in rest
