"""Recordings are complete to the last whole frame, however they end, and the readers of other commands accept them."""

import csv
import dataclasses
import errno
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from small_sensor import CHANNELS, measured, noisy

from jeit.data import load_description, read, read_frame_recording
from jeit.live import recording
from jeit.live.pictures import LiveFrame
from jeit.live.recording import Recorder
from jeit.mesh import Disk

HERE = Path(__file__).resolve().parent


def frame(number, values, second=None):
    second = number / 60 if second is None else second
    return LiveFrame(number, second, time.monotonic(), values)


def wait_for(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


def state_of(recorder):
    state = recorder.state()
    assert state is not None
    return state


def test_a_recording_is_read_with_its_times_description_and_reference(tmp_path):
    reference = measured()
    recorder, frames = Recorder(tmp_path, reference=reference), noisy(30, seed=2)
    frames[4, 7] = np.nan
    folder = recorder.start()
    assert recorder.start() == folder
    for number, values in enumerate(frames):
        recorder.add(frame(number, values))
    recorder.mark(0.25, "a, touch\nbegins")
    recorder.add(frame(30, "half a line 0.1, 0."))
    recorder.add(frame(31, np.zeros(CHANNELS + 1)))
    assert "30 frames" in recorder.stop()
    assert recorder.state() is None
    again = read(folder / "reference.npz")
    np.testing.assert_array_equal(again.voltages, reference.voltages)
    for like in (None, again):
        found = read(folder / "frames.csv", like=like)
        known = np.asarray(found.mask)
        assert not known[4, 7]
        assert known.sum() == frames.size - 1
        np.testing.assert_array_equal(np.asarray(found.voltages)[known], frames[known])
        np.testing.assert_allclose(np.asarray(found.times), np.arange(30) / 60, atol=1e-6)
        assert found.protocol.same_patterns(reference.protocol)
        assert found.electrodes is not None
    with (folder / "events.csv").open() as file:
        assert list(csv.reader(file)) == [["second", "text"], ["0.250000", "a, touch begins"]]
    with (folder / "refused.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[1] == ["0.500000", "half a line 0.1, 0."]
    assert rows[2][1].split() == ["0.0"] * (CHANNELS + 1)


def test_a_reference_is_recorded_without_a_body_that_no_description_expresses(tmp_path):
    reference = dataclasses.replace(measured(), domain=Disk(0.1).mesh(num_points=30))
    recorder = Recorder(tmp_path, reference=reference)
    folder = recorder.start()
    recorder.add(frame(0, noisy(1)[0]))
    recorder.stop()
    again = read(folder / "reference.npz")
    np.testing.assert_array_equal(again.voltages, reference.voltages)
    assert again.protocol.same_patterns(reference.protocol)
    assert again.domain is None


def test_the_readers_of_skins_accept_it_too(tmp_path):
    recorder, frames = Recorder(tmp_path, reference=measured()), noisy(12, seed=3)
    folder = recorder.start()
    for number, values in enumerate(frames):
        recorder.add(frame(number, values))
    recorder.stop()
    found = read_frame_recording(folder / "frames.csv", load_description(folder / "description.toml"))
    np.testing.assert_array_equal(found.frames, frames)
    np.testing.assert_allclose(np.asarray(found.seconds), np.arange(12) / 60, atol=1e-6)


def test_a_recording_that_was_cut_off_anywhere_in_a_line_is_read_to_the_frame_before(tmp_path):
    """As by a process that is killed while the system copies a line that is on two pages."""
    recorder, frames = Recorder(tmp_path, reference=measured()), noisy(4)
    frames[3, -1] = np.nan
    folder = recorder.start()
    for number, values in enumerate(frames):
        recorder.add(frame(number, values))
    recorder.stop()
    content, described = (folder / "frames.csv").read_bytes(), load_description(folder / "description.toml")
    whole = content[:-1].rindex(b"\n") + 1
    for end in (
        whole + 1,
        whole + 9,
        whole + 60,
        len(content) - 40,
        len(content) - 3,
        len(content) - 2,
        len(content) - 1,
    ):
        (folder / "frames.csv").write_bytes(content[:end])
        found = np.asarray(read(folder / "frames.csv").voltages)
        assert len(found) in (3, 4)
        np.testing.assert_array_equal(found[:3], frames[:3])
        np.testing.assert_array_equal(read_frame_recording(folder / "frames.csv", described).frames[:3], frames[:3])


def test_frames_of_one_moment_have_increasing_times(tmp_path):
    recorder = Recorder(tmp_path, reference=measured())
    folder = recorder.start()
    seconds = 1.0 + np.array([0, 0, 4e-7, 5e-7, 1.4e-6, 1.5e-6, 1.5e-6, 3e-6])
    for number, values in enumerate(noisy(8)):
        recorder.add(frame(number, values, second=float(seconds[number])))
    recorder.stop()
    times = np.asarray(read(folder / "frames.csv").times)
    assert (np.diff(times) > 0).all()
    np.testing.assert_allclose(times, 1.0, atol=1e-5)


def test_two_recordings_are_in_two_folders_and_each_has_its_own_frames(tmp_path):
    recorder = Recorder(tmp_path)
    frames, folders = noisy(4), []
    recorder.add(frame(0, frames[0]))
    for count in (3, 1):
        folders.append(recorder.start())
        for number in range(count):
            recorder.add(frame(number, frames[number]))
        recorder.stop()
    assert folders[0] != folders[1]
    assert [len((one / "frames.csv").read_text().splitlines()) for one in folders] == [4, 2]


class FullDisk:
    """`os.write` of a disk with `room` bytes: content that does not fit is written in part, then refused."""

    def __init__(self, room):
        self.room, self.write = room, os.write

    def __call__(self, descriptor, content):
        if self.room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        fits = content[: self.room]
        self.room -= len(fits)
        return self.write(descriptor, fits)


@pytest.mark.parametrize("room", [0, 3, 1000, 2048])
def test_a_full_disk_leaves_whole_frames_and_the_rest_follows_when_there_is_space(room, tmp_path, monkeypatch):
    recorder, frames = Recorder(tmp_path), noisy(20)
    folder = recorder.start()
    disk = FullDisk(room)
    monkeypatch.setattr(recording.os, "write", disk)
    monkeypatch.setattr(recording, "_RETRY_PERIOD", 0.02)
    for number, values in enumerate(frames):
        recorder.add(frame(number, values))
    wait_for(lambda: state_of(recorder)["problem"])
    assert "full" in state_of(recorder)["problem"]
    content = (folder / "frames.csv").read_bytes()
    assert content == b"" or content.endswith(b"\n")
    assert len(content) <= room
    disk.room = 10**9
    wait_for(lambda: state_of(recorder)["frames"] == 20)
    assert state_of(recorder)["problem"] is None
    assert recorder.stop().endswith(f"20 frames in {folder}.")
    rows = np.loadtxt(folder / "frames.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows[:, 1:], frames)


def test_an_abandoned_recording_writes_nothing_into_the_next(tmp_path, monkeypatch):
    """The disk blocks while the first recording ends. The second begins before the disk responds."""
    recorder, frames, goes_on, written = Recorder(tmp_path), noisy(3), threading.Event(), os.write

    def hangs(descriptor, content):
        goes_on.wait(5)
        return written(descriptor, content)

    monkeypatch.setattr(recording.os, "write", hangs)
    monkeypatch.setattr(recording, "_END_TIMEOUT", 0.05)
    first = recorder.start()
    hung = recorder._writer_thread
    recorder.add(frame(0, frames[0]))
    assert "Not recorded" in recorder.stop()
    second = recorder.start()
    recorder.add(frame(1, frames[1]))
    goes_on.set()
    assert hung is not None
    hung.join(5)
    recorder.add(frame(2, frames[2]))
    monkeypatch.setattr(recording, "_END_TIMEOUT", 10.0)
    assert "2 frames" in recorder.stop()
    rows = np.loadtxt(second / "frames.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows[:, 1:], frames[1:])
    assert len((first / "frames.csv").read_text().splitlines()) <= 2


def test_frames_without_space_are_counted(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path)
    recorder.start()
    monkeypatch.setattr(recording.os, "write", FullDisk(0))
    monkeypatch.setattr(recording, "_MAX_WAITING_BYTES", 5000)
    for number, values in enumerate(noisy(30)):
        recorder.add(frame(number, values))
    wait_for(lambda: recorder._num_lost_lines)
    assert "could not be recorded" in state_of(recorder)["problem"]
    report = recorder.stop()
    assert "0 frames" in report
    assert "Not recorded, for there was no room: 30 lines" in report


def test_long_recordings_are_in_parts_that_can_be_read_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "_MAX_FILE_SIZE", 5000)
    recorder, frames = Recorder(tmp_path, reference=measured()), noisy(30)
    folder = recorder.start()
    for number, values in enumerate(frames):
        recorder.add(frame(number, values))
    recorder.stop()
    parts = [folder / "frames.csv", *(folder / f"frames-{one}.csv" for one in range(2, 20))]
    found = np.concatenate([read(one).voltages for one in parts if one.exists()])
    assert sum(one.exists() for one in parts) > 3
    np.testing.assert_array_equal(found, frames)


PARTS = ("frames.csv", "frames-2.csv", "frames-3.csv")


def test_an_unknown_sensor_may_begin_with_half_a_line_and_change_its_channels(tmp_path):
    recorder, frames = Recorder(tmp_path), noisy(9)
    folder = recorder.start()
    for number, values in enumerate([np.zeros(7), *frames[:6], *frames[6:, :30], frames[0], *frames[6:, :30]]):
        recorder.add(frame(number, values))
    recorder.stop()
    refused = (folder / "refused.csv").read_text().splitlines()
    widths = [np.loadtxt(folder / name, delimiter=",", skiprows=1, ndmin=2).shape for name in PARTS]
    assert widths == [(1, 8), (4, CHANNELS + 1), (4, 31)]
    assert len(refused) == 1 + 5


def test_a_new_reference_is_saved_beside_the_first(tmp_path):
    recorder, frames = Recorder(tmp_path, reference=measured()), noisy(5)
    folder = recorder.start()
    recorder.renew(2.5, frames)
    recorder.stop()
    np.testing.assert_array_equal(np.load(folder / "reference-2.500s.npy"), frames)
    assert "new reference" in (folder / "events.csv").read_text()


KILLED = """
import sys, time
import numpy as np
sys.path.insert(0, sys.argv[2])
from small_sensor import measured, noisy
from jeit.live.pictures import LiveFrame
from jeit.live.recording import Recorder
recorder = Recorder(sys.argv[1], reference=measured())
print(recorder.start(), flush=True)
frames = noisy(200)
number = 0
while True:
    recorder.add(LiveFrame(number, number / 1000, time.monotonic(), frames[number % 200]))
    number += 1
    time.sleep(0.001)
    if recorder.state()["frames"] % 50 == 0:
        print(recorder.state()["frames"], flush=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills a process by a signal")
def test_a_killed_process_leaves_all_whole_frames(tmp_path):
    """The process reports how many frames are written. At least as many are read, all of them correct."""
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path), str(HERE)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        folder, written = Path(process.stdout.readline().strip()), 0
        while written < 150:
            written = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
    found = read(folder / "frames.csv")
    assert found.num_frames >= written
    np.testing.assert_array_equal(found.voltages, noisy(200)[np.arange(found.num_frames) % 200])
    assert read(folder / "reference.npz").num_frames == 20
