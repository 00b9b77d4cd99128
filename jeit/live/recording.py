"""Recordings of live sessions: frames are written one by one, so that a recording is complete to its last whole frame
whatever ends it.

A recording is a folder with frames.csv (a line a frame: seconds, then volts; nan without a reading), refused.csv (lines
that were no frames), events.csv, description.toml (of the sensor) and reference.npz (frames of the
undisturbed sensor, with its protocol). `jeit stream`, `jeit series` and `jeit touch watch` read frames.csv.
"""

from __future__ import annotations

import csv
import errno
import io
import os
import threading
import time
from collections import deque
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from jeit.arguments import counted
from jeit.data import Measurement, write_table
from jeit.live.pictures import LiveFrame

FRAMES, REFUSED, EVENTS = "frames.csv", "refused.csv", "events.csv"
REFERENCE, DESCRIPTION = "reference.npz", "description.toml"
# Memory of frames that wait for a disk that is slow or full, bytes; seconds between trials to write to a full disk,
# between the moments at which everything written is on the disk itself, and for which the end of a recording waits.
_MOST_WAITING, _RETRY, _SYNCHRONISE, _LONGEST_END = 64_000_000, 1.0, 2.0, 10.0
# Size of a part of a recording, bytes: a reader needs eight times that, and may have a gigabyte.
_PART = 100_000_000
# How names of files of frames begin; frames of another number of channels, one after another, that begin a new part.
_STEM, _OTHERS = "frames", 3
_BINARY = getattr(os, "O_BINARY", 0)  # of Windows, which else changes line ends


class Recorder:
    """Writes recordings, each into a new folder named by date and time.

    Frames are written by a thread of their own. If the disk is full, frames wait in memory, 64 MB of them, and are
    written once there is room again; the file ends with a whole frame at any time.

    **Arguments:**

    - `folder`: the folder below which recordings are written.
    - `reference`: a measurement of the undisturbed sensor, which is written beside the frames, with a description that
      reads them.

    **Example:**

    ```python
    recorder = Recorder("recordings", reference=reference)
    for result in frames(simulated_tank(100.0, limit=20), view, recorder=recorder):
        print(result.frame.number)
    ```
    """

    def __init__(self, folder: str | Path, *, reference: Measurement | None = None):
        self.folder, self.reference = Path(folder), reference
        self._changed = threading.Condition()
        self._lines: deque[tuple[str, bytes]] = deque()
        self._waiting = self._lost = 0
        self._problem = ""
        self._into: _Files | None = None
        self._thread: threading.Thread | None = None
        self._ending = False
        self._last = -1
        self._channels = self._width = None if reference is None else reference.num_channels
        self._others = self._part = self._size = 0

    def start(self) -> Path:
        """Begin a recording, unless one is under way, and return its folder. Raises `OSError` if that cannot be
        made."""
        if self._into is not None:
            return self._into.folder
        folder = _new_folder(self.folder)
        if self.reference is not None:
            _write_reference(self.reference, folder)
        with self._changed:
            self._into, self._ending, self._problem = _Files(folder), False, ""
            self._lost = 0
            self._last, self._width = -1, self._channels
            self._others, self._part, self._size = 0, 1, 0
            self._lines.clear()
            self._waiting = 0
            self._thread = threading.Thread(
                target=self._writing, args=(self._into,), name="jeit live recorder", daemon=True
            )
            self._thread.start()
        return folder

    def stop(self) -> str:
        """End the recording, wait until all is written, ten seconds at most, and return a sentence about it; an empty
        one if no recording was under way."""
        with self._changed:
            thread, into, self._ending = self._thread, self._into, True
            self._changed.notify_all()
        if thread is None or into is None:
            return ""
        thread.join(_LONGEST_END)
        with self._changed:
            self._into = self._thread = None
            lost = self._lost + len(self._lines)
            self._lines.clear()
            self._waiting = 0
        said = f"Recorded: {counted(into.frames, 'frame')} in {into.folder}."
        return f"{said} Not recorded, for there was no room: {counted(lost, 'line')}." if lost else said

    def add(self, frame: LiveFrame) -> None:
        """Record a frame; does nothing while no recording is under way."""
        if self._into is None:
            return
        values = frame.values
        if isinstance(values, str) or values.ndim != 1:
            self._put(REFUSED, _row(frame.second, str(values)))
            return
        if not self._fits(values):
            self._put(REFUSED, _row(frame.second, " ".join(map(repr, values.tolist()))))
            return
        # A column of times is recognised by its rising, here by a microsecond at least.
        self._last = max(round(1e6 * frame.second), self._last + 1)
        line = f"{self._last / 1e6:.6f},{','.join(map(repr, values.astype(float).tolist()))}\n".encode()
        if self._size + len(line) > _PART:
            self._part, self._size = self._part + 1, 0
        self._size += len(line)
        self._put(FRAMES if self._part == 1 else f"frames-{self._part}.csv", line)

    def _fits(self, values: np.ndarray) -> bool:
        """Whether a frame has as many channels as the others. If the sensor is not known, three frames of another
        number begin a new part."""
        if values.dtype.kind not in "iuf":
            return False
        if self._width is None:
            self._width = len(values)
        if len(values) == self._width:
            self._others = 0
            return True
        self._others += 1
        if self._channels is not None or self._others < _OTHERS:
            return False
        if self._size:
            self._part, self._size = self._part + 1, 0
        self._width, self._others = len(values), 0
        return True

    def mark(self, second: float, label: str) -> None:
        """Record an event."""
        if self._into is not None:
            self._put(EVENTS, _row(second, label))

    def renew(self, second: float, frames: np.ndarray) -> None:
        """Record frames (N, M) of a new reference, beside the first one, and when it was taken."""
        if self._into is None:
            return
        name = f"reference-{second:.3f}s.npy"
        try:
            np.save(self._into.folder / name, frames)
        except OSError as error:
            self._problem = f"The new reference is not recorded: {error.strerror}."
            return
        self.mark(second, f"new reference, {name}")

    def state(self) -> dict[str, Any] | None:
        """Folder, number of frames and bytes written, and what is wrong, of the recording under way; None without."""
        with self._changed:
            into = self._into
            if into is None:
                return None
            return {
                "folder": str(into.folder),
                "frames": into.frames,
                "bytes": into.bytes,
                "problem": self._problem or None,
            }

    def _put(self, name: str, line: bytes) -> None:
        with self._changed:
            if self._waiting + len(line) > _MOST_WAITING:
                self._lost += 1
                self._problem = f"The disk is full or too slow: {counted(self._lost, 'line')} could not be recorded."
                return
            self._lines.append((name, line))
            self._waiting += len(line)
            self._changed.notify_all()

    def _writing(self, into: _Files) -> None:
        synchronised = time.monotonic()
        while (waiting := self._next(into)) is not None:
            try:
                into.write(*waiting)
            except OSError as error:
                with self._changed:
                    if self._ends(into):
                        break
                    self._problem = _described(error)
                    self._changed.wait_for(lambda: self._ends(into), _RETRY)
                continue
            with self._changed:
                if self._into is not into:  # it took so long that the recording was given up
                    break
                self._lines.popleft()
                self._waiting -= len(waiting[1])
                if not self._lost:
                    self._problem = ""
            if time.monotonic() - synchronised > _SYNCHRONISE:
                into.synchronise()
                synchronised = time.monotonic()
        into.close()

    def _next(self, into: _Files) -> tuple[str, bytes] | None:
        """Wait for a line to write, which stays the first in the queue; None once the recording ends."""
        with self._changed:
            while not self._lines or self._into is not into:
                if self._ends(into):
                    return None
                self._changed.wait(_SYNCHRONISE)
            return self._lines[0]

    def _ends(self, into: _Files) -> bool:
        return self._ending or self._into is not into


class _Files:
    """The files of a recording, each of which ends with a whole line at any time."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.frames = self.bytes = 0
        self._open: dict[str, int] = {}
        self._sizes: dict[str, int] = {}

    def write(self, name: str, line: bytes) -> None:
        """Write a line whole, or nothing of it. Raises `OSError` if it cannot be written."""
        if name not in self._open:
            self._begin(name, line)
        self._append(self._open[name], self._sizes[name], line)
        self._sizes[name] += len(line)
        self.bytes += len(line)
        self.frames += name.startswith(_STEM)

    def _begin(self, name: str, line: bytes) -> None:
        """Make a file, with its heading."""
        heading = b"second,text\n"
        if name.startswith(_STEM):
            heading = ("second," + ",".join(f"v{one + 1}" for one in range(line.count(b","))) + "\n").encode()
        descriptor = os.open(self.folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | _BINARY, 0o644)
        try:
            self._append(descriptor, 0, heading)
        except OSError:
            os.close(descriptor)
            raise
        if name.startswith(_STEM):
            for part in [one for one in self._open if one.startswith(_STEM)]:
                os.close(self._open.pop(part))
        self._open[name], self._sizes[name] = descriptor, len(heading)

    @staticmethod
    def _append(descriptor: int, size: int, line: bytes) -> None:
        """Write a line at the end of a file of that size; if that fails, the file keeps its size."""
        try:
            done = os.write(descriptor, line)
            while done < len(line):
                done += os.write(descriptor, line[done:])
        except OSError:
            with suppress(OSError):
                os.ftruncate(descriptor, size)
                os.lseek(descriptor, size, os.SEEK_SET)
            raise

    def synchronise(self) -> None:
        """Have all that is written on the disk itself."""
        for descriptor in self._open.values():
            with suppress(OSError):
                os.fsync(descriptor)

    def close(self) -> None:
        self.synchronise()
        for descriptor in self._open.values():
            with suppress(OSError):
                os.close(descriptor)
        self._open.clear()


def _new_folder(folder: Path) -> Path:
    """A new folder below `folder`, named by date and time."""
    folder.mkdir(parents=True, exist_ok=True)
    name = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    for number in range(1, 1000):
        made = folder / (name if number == 1 else f"{name}_{number}")
        with suppress(FileExistsError):
            made.mkdir()
            return made
    raise FileExistsError(errno.EEXIST, "there are a thousand recordings of this second", str(folder))


def _write_reference(reference: Measurement, folder: Path) -> None:
    """Write the reference, and a description that reads frames.csv."""
    try:
        _, description = write_table(reference, folder / REFERENCE)
    except ValueError:  # a body that a description cannot express
        plain = Measurement(reference.voltages, reference.mask, reference.protocol, name=reference.name)
        _, description = write_table(plain, folder / REFERENCE)
    text = description.read_text("utf-8")
    (folder / DESCRIPTION).write_text(text, "utf-8")


def _row(second: float, text: str) -> bytes:
    """A line of a table of times and texts."""
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerow([f"{second:.6f}", " ".join(text.split())])
    return written.getvalue().encode("utf-8", "replace")


def _described(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "The disk is full: frames wait in memory until there is room."
    return f"Frames cannot be written, and wait in memory: {error.strerror or error}."
