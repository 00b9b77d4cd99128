"""A device on a pseudo-terminal, read, recorded and imaged live, with faults: lost frames, latency and memory.

A separate process sends the frames of a simulated tank at 60 frames/s, with a series of faults: garbage, half a line,
another number of channels, no readings, twice the rate, and nothing while it is unplugged and plugged in again. Latency
is the time from the moment at which a frame was written until its picture was computed; a browser is not included.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.cases.soak import resident_memory
from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say
from benchmarks.problems import played_device
from benchmarks.problems.played_device import ENTRY, FAULTS
from jeit.data import read
from jeit.imaging.stream_preparation import StreamSettings
from jeit.live.pictures import AbstractView
from jeit.live.recording import Recorder
from jeit.live.session import Session
from jeit.live.simulated import SimulatedSensor, simulated_tank
from jeit.live.sources import open_source
from jeit.live.views.conductivity import ConductivityView

RATE = 60.0
# Seconds of each stream and seconds between faults, in a full run (False) and in a quick run (True).
LENGTHS = {False: (600.0, 7.0), True: (5.0, 1.0)}
# Fraction by which memory may grow after a quarter of the stream (the first minute fills the store of pictures); limits
# of the median and the 99th percentile of latency in seconds; least number of pictures per second.
GROWTH, MEDIAN, HIGH, PICTURES = 0.05, 0.05, 0.1, 20.0
_LINES = 997


class Streamed(NamedTuple):
    """Result of a stream: simulated faults by kind, numbers of frames sent completely and of frames recorded in order,
    the state of the session, seconds from writing a frame to its picture, pictures per second, and memory in MB at a
    quarter and at the end of the stream.
    """

    planted: Counter[str]
    sent: int
    recorded: int
    state: dict
    latency: np.ndarray
    pictures: float
    memory: list[float]


def run(options: Options) -> Result:
    """Stream with linear images, and with Gauss-Newton images."""
    if os.name != "posix":
        return Result([], notes=["Pseudo-terminals are needed, which this system does not have."])
    seconds, period = LENGTHS[options.quick]
    tank = simulated_tank()
    rows, asked = [], []
    for name, solver in (("linear", "one-step"), ("Gauss-Newton", "gauss-newton")):
        view = ConductivityView.prepare(tank.reference, StreamSettings(solver=solver))
        with tempfile.TemporaryDirectory() as folder:
            found = stream(view, tank.reference, _frames(tank), Path(folder), seconds, period)
        state, (quarter, end) = found.state, found.memory
        median, high = np.quantile(found.latency, (0.5, 0.99))
        faults = ", ".join(f"{found.planted[kind]} {kind}" for kind in FAULTS if found.planted[kind])
        rows.append(
            [
                name,
                f"{found.sent:,}",
                f"{found.recorded:,}",
                f"{state['dropped']:,}",
                str(state["refused"]),
                duration(median),
                duration(high),
                f"{found.pictures:.1f}",
                f"{quarter:.0f} MB",
                f"{end:.0f} MB",
                faults,
            ]
        )
        say(" | ".join(rows[-1]))
        lost = found.sent - found.recorded
        asked += [
            judged(f"{name}: no frame lost from the recording", f"{lost} of {found.sent:,}", lost == 0),
            judged(
                f"{name}: latency ≤ {1e3 * MEDIAN:.0f} ms, 99 % ≤ {1e3 * HIGH:.0f} ms",
                f"{duration(median)}, {duration(high)}",
                median <= MEDIAN and high <= HIGH,
            ),
            judged(f"{name}: ≥ {PICTURES:g} pictures a second", f"{found.pictures:.1f}", found.pictures >= PICTURES),
            judged(
                f"{name}: memory grows by ≤ {GROWTH:.0%}", f"{end / quarter - 1:+.1%}", end <= (1 + GROWTH) * quarter
            ),
        ]
    header = [
        "images",
        "frames sent",
        "recorded",
        "not shown",
        "refused",
        "latency: median",
        "99 %",
        "pictures a second",
    ]
    header += ["memory at 25 %", "at the end", "faults"]
    return Result(
        [Table(header, rows, f"16 electrodes, 208 voltages, {RATE:g} frames/s for {seconds:g} s each")], asked
    )


def stream(view: AbstractView, reference, frames: np.ndarray, folder: Path, seconds: float, period: float) -> Streamed:
    """Simulate a device for a number of seconds, and read, record and image its frames."""
    lines, link, log = (folder / name for name in ("lines.txt", "device", "log"))
    lines.write_text("".join(", ".join(map(repr, one)) + "\n" for one in frames.tolist()))
    recorder = Recorder(folder / "recordings", reference=reference)
    arguments = [sys.executable, played_device.__file__, lines, link, log, seconds, RATE, period]
    made: list[tuple[float, float]] = []  # arrival and latency of each imaged frame
    planted: Counter[str] = Counter()
    with subprocess.Popen(
        [str(one) for one in arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as device:
        assert device.stdin is not None
        assert device.stdout is not None
        output = device.stdout
        listening = threading.Thread(target=lambda: planted.update(line.strip() for line in output), daemon=True)
        listening.start()
        session = Session(
            open_source(f"serial:{link}@115200", reference=reference), _Noting(view, made), recorder=recorder
        )
        session.record(True)
        with session:
            while not link.exists() or session.state()["connection"] != "connected":
                session.newest(-1, 0.05)
            device.stdin.write("go\n")
            device.stdin.flush()
            with suppress(subprocess.TimeoutExpired):
                device.wait(seconds / 4)
            memory = [resident_memory()]
            device.wait()
            memory.append(resident_memory())
            listening.join()
            state = session.state()
            recorded_in = state["recording"]["folder"]
    entries = list(ENTRY.iter_unpack(log.read_bytes()))
    recorded = _recorded(Path(recorded_in))
    expected = frames[[number for number, _ in entries]]
    latency, span = _latencies([at for _, at in entries], made), entries[-1][1] - entries[0][1]
    return Streamed(planted, len(entries), _in_order(recorded, expected), state, latency, len(made) / span, memory)


class _Noting(AbstractView):
    """A view that records when the last byte of a frame arrived and when its picture was made."""

    def __init__(self, view: AbstractView, made: list[tuple[float, float]]):
        self.view, self.made, self.scene = view, made, view.scene

    def picture(self, frame):
        picture = self.view.picture(frame)
        if picture.pixels is not None:
            self.made.append((frame.arrived, time.monotonic()))
        return picture

    def set_reference(self, frames) -> None:
        self.view.set_reference(frames)


def _latencies(written: list[float], made: list[tuple[float, float]]) -> np.ndarray:
    """Latency of each picture: seconds from the writing of the last frame before its arrival until the picture was
    computed."""
    arrived, done = np.array(made).T
    before = np.searchsorted(written, arrived, side="right") - 1
    # A frame may arrive before the device has recorded the time of writing.
    return done - np.minimum(np.array(written)[np.maximum(before, 0)], arrived)


def _in_order(recorded: np.ndarray, expected: np.ndarray) -> int:
    """Number of the expected frames that were recorded in the same order; other recorded frames may lie between
    them."""
    place = found = 0
    for one in expected:
        while place < len(recorded) and not np.array_equal(recorded[place], one):
            place += 1
        if place == len(recorded):
            break
        found, place = found + 1, place + 1
    return found


def _frames(tank: SimulatedSensor) -> np.ndarray:
    """997 different frames (997, channels) of one rotation of the rod, with noise."""
    states = tank.states[np.arange(_LINES) * len(tank.states) // _LINES]
    noise = 1e-4 * np.sqrt(np.mean(states**2))
    return states + noise * np.random.default_rng(0).standard_normal(states.shape)


def _recorded(folder: Path) -> np.ndarray:
    """Frames of all files of a recording, concatenated."""
    parts = [folder / "frames.csv", *(folder / f"frames-{part}.csv" for part in range(2, 100))]
    return np.concatenate([np.asarray(read(one).voltages) for one in parts if one.exists()])


CASE = Case("live", "a device with faults, read, recorded and imaged live: lost frames, latency, memory", run, 21)
