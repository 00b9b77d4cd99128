"""Ctrl-C and SIGTERM at any moment of a stream: the files are readable and the exit status names the signal."""

import csv
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from typer import Exit

from jeit.cli.streams import StreamStopper

SIGNALS = [signal.SIGINT, signal.SIGTERM]
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


def read(folder):
    """Frames in the table and in the NPZ file; every line is complete."""
    with open(folder / "frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert all(None not in row.values() and row["status"] for row in rows)
    with np.load(folder / "images.npz") as held:
        return len(rows), len(held["conductivity"])


@pytest.fixture
def streamed(tank, run, tmp_path, monkeypatch):
    """Run `jeit stream` on these lines of standard input."""

    def call(lines):
        monkeypatch.setattr("sys.stdin", lines)
        given = "--reference", tank.folder / "rest.csv", "--output", tmp_path / "out", "--method", "one-step"
        return run("stream", "-", *given, "--num-points", 250, "--quiet", "--film", "none")

    return call


def lines(tank, number, *then):
    """Yield a number of frames, then the results of these calls."""
    for _ in range(number):
        yield " ".join(map(repr, map(float, tank.touched)))
    for one in then:
        if (line := one()) is not None:
            yield line


@pytest.mark.parametrize("number", SIGNALS)
def test_while_waiting_for_a_frame(number, tank, streamed, tmp_path):
    handlers = [signal.getsignal(one) for one in SIGNALS]
    status, out, error = streamed(lines(tank, 3, lambda: signal.raise_signal(number)))
    assert (status, out) == (128 + number, "")
    assert error == "jeit: stopped after 3 frames; frames.csv and images.npz have them.\n"
    assert read(tmp_path / "out") == (3, 3)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["frames.csv", "images.npz"]
    assert [signal.getsignal(one) for one in SIGNALS] == handlers


def test_before_there_is_a_frame(tank, streamed, tmp_path):
    status, _, error = streamed(lines(tank, 0, lambda: signal.raise_signal(signal.SIGTERM)))
    assert (status, error) == (143, "jeit: stopped after 0 frames.\n")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["frames.csv"]


def test_before_the_first_frame_is_requested(streamed, tank, monkeypatch):
    monkeypatch.setattr("jeit.report.write_stream", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    assert streamed(lines(tank, 3)) == (130, "", "jeit: stopped after 0 frames.\n")


def test_while_the_model_is_prepared(tank, streamed, tmp_path, monkeypatch):
    monkeypatch.setattr("jeit.imaging.stream_preparation.find_wiring", lambda *_: signal.raise_signal(signal.SIGTERM))
    status, _, error = streamed(lines(tank, 3))
    assert (status, error) == (143, "jeit: stopped.\n")
    assert not (tmp_path / "out").exists()


def test_a_frame_in_progress_is_finished(tank, streamed, tmp_path, monkeypatch):
    from jeit.report import stream as stream_module

    row = stream_module._table_row

    def signalled(one, *rest):
        if one.number == 1:
            signal.raise_signal(signal.SIGINT)
        return row(one, *rest)

    monkeypatch.setattr(stream_module, "_table_row", signalled)
    status, _, error = streamed(lines(tank, 5))
    assert (status, error) == (130, "jeit: stopped after 2 frames; frames.csv and images.npz have them.\n")
    assert read(tmp_path / "out") == (2, 2)


@pytest.mark.slow
def test_while_images_are_written_and_by_a_second_signal(tank, streamed, tmp_path, monkeypatch):
    from jeit.report.stream import GrowingRows

    write, times = GrowingRows.write_npz, [1]

    def signalled(self, *given):
        for _ in range(times[0]):
            signal.raise_signal(signal.SIGTERM)
        return write(self, *given)

    monkeypatch.setattr(GrowingRows, "write_npz", signalled)
    status, _, error = streamed(lines(tank, 3))
    assert (status, error) == (143, "jeit: stopped after 3 frames; frames.csv and images.npz have them.\n")
    assert read(tmp_path / "out") == (3, 3)
    times[0] = 2
    status, _, error = streamed(lines(tank, 3))
    assert (status, error) == (143, "jeit: stopped.\n")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["frames.csv"]


def test_reconstruct_is_stopped(tank, run, tmp_path, monkeypatch):
    monkeypatch.setattr("jeit.imaging.preparation.find_wiring", lambda *_: signal.raise_signal(signal.SIGINT))
    given = "--reference", tank.folder / "rest.csv", "--num-points", 250, "--quiet", "--output", tmp_path / "a" / "out"
    assert run("reconstruct", tank.folder / "touched.csv", *given) == (130, "", "jeit: stopped.\n")
    assert not (tmp_path / "a").exists()


def test_ignored_signals_stay_ignored():
    """As under nohup."""
    earlier = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with StreamStopper() as stopping:
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            signal.raise_signal(signal.SIGINT)
            assert list(stopping.frames_until_signal([1, 2])) == [1, 2]
    finally:
        signal.signal(signal.SIGINT, earlier)


def test_a_second_signal_ends_the_process_at_once():
    def stream():
        with StreamStopper() as stopping:
            for _ in stopping.frames_until_signal(range(9)):
                signal.raise_signal(signal.SIGINT)
                signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Exit) as raised:
        stream()
    assert raised.value.exit_code == 143


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("moment", [0.0, 0.05, 0.2, 0.5])
def test_in_a_process_of_its_own(number, moment, tank, tmp_path):
    """The signal comes shortly after the first frame, while frames arrive faster than they are imaged."""
    command = [sys.executable, "-m", "jeit", "stream", "-", "--reference", tank.folder / "rest.csv"]
    command += ["--output", tmp_path / "out", "--num-points", "250", "--quiet"]
    line = " ".join(map(repr, map(float, tank.touched))) + "\n"
    table = tmp_path / "out" / "frames.csv"
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        process.stdin.write(line)
        process.stdin.flush()
        while not table.exists() or table.read_bytes().count(b"\n") < 2:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.02)
        os.set_blocking(process.stdin.fileno(), False)
        end = time.monotonic() + moment
        while time.monotonic() < end:
            try:
                os.write(process.stdin.fileno(), line.encode())
            except BlockingIOError:
                time.sleep(0.001)
        process.send_signal(number)
        error = process.stderr.read()
    assert process.returncode == 128 + number, error
    come, held = read(tmp_path / "out")
    assert come == held >= 1
    assert f"stopped after {come} frame" in error
