"""Recordings of live sessions. Frames are written one by one, so that the file ends with a complete frame even if the
program is interrupted.

A recording is a folder with frames.csv (one line per frame: time in seconds, then volts; nan for missing readings),
refused.csv (lines that were not frames), events.csv, description.toml (of the sensor) and reference.npz (frames of the
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
# Maximum memory in bytes of frames that wait for a slow or full disk. Times in seconds: between attempts to write to a
# full disk, between synchronisations of the files with the disk, and maximum duration of ending a recording.
_MAX_WAITING_BYTES, _RETRY_PERIOD, _SYNC_PERIOD, _END_TIMEOUT = 64_000_000, 1.0, 2.0, 10.0
# Maximum size in bytes of a file of frames. Readers need memory of eight times the file size, which this limit keeps
# below a gigabyte.
_MAX_FILE_SIZE = 100_000_000
# Prefix of the names of files of frames.
_FRAMES_PREFIX = "frames"
# Number of successive frames with a different number of channels after which a new file is begun.
_NUM_OTHER_LENGTHS = 3
_BINARY_FILE_FLAG = getattr(os, "O_BINARY", 0)  # prevents Windows from changing line ends


class Recorder:
    """Writes recordings, each into a new folder named by date and time.

    Frames are written in a separate thread. If the disk is full, frames wait in memory, up to 64 MB, and are written
    when the disk has space again. The file always ends with a complete frame.

    **Arguments:**

    - `folder`: the folder below which recordings are written.
    - `reference`: a measurement of the undisturbed sensor; it is written beside the frames, with a description with
      which `jeit.data.read` reads the frames.

    **Example:**

    ```python
    recorder = Recorder("recordings", reference=reference)
    for result in frames(simulated_tank(100.0, limit=20), view, recorder=recorder):
        print(result.frame.number)
    ```
    """

    def __init__(self, folder: str | Path, *, reference: Measurement | None = None):
        self.folder, self.reference = Path(folder), reference
        self._queue_condition = threading.Condition()
        self._queued_lines: deque[tuple[str, bytes]] = deque()
        self._waiting_bytes = self._num_lost_lines = 0
        self._problem_text = ""
        self._recording_files: _RecordingFiles | None = None
        self._writer_thread: threading.Thread | None = None
        self._is_stopping = False
        self._last_microsecond = -1
        self._num_channels = self._frame_length = None if reference is None else reference.num_channels
        self._num_other_lengths = self._file_number = self._file_size = 0

    def start(self) -> Path:
        """Begin a recording, unless a recording is in progress, and return the folder of the recording. Raises
        `OSError` if the folder cannot be created."""
        if self._recording_files is not None:
            return self._recording_files.folder
        folder = _create_new_folder(self.folder)
        if self.reference is not None:
            _write_reference(self.reference, folder)
        with self._queue_condition:
            self._recording_files, self._is_stopping, self._problem_text = _RecordingFiles(folder), False, ""
            self._num_lost_lines = 0
            self._last_microsecond, self._frame_length = -1, self._num_channels
            self._num_other_lengths, self._file_number, self._file_size = 0, 1, 0
            self._queued_lines.clear()
            self._waiting_bytes = 0
            self._writer_thread = threading.Thread(
                target=self._write_lines, args=(self._recording_files,), name="jeit live recorder", daemon=True
            )
            self._writer_thread.start()
        return folder

    def stop(self) -> str:
        """End the recording, and wait until all frames are written, for at most ten seconds. Returns a sentence for the
        user; an empty string if no recording was in progress."""
        with self._queue_condition:
            writer_thread, recording_files, self._is_stopping = self._writer_thread, self._recording_files, True
            self._queue_condition.notify_all()
        if writer_thread is None or recording_files is None:
            return ""
        writer_thread.join(_END_TIMEOUT)
        with self._queue_condition:
            self._recording_files = self._writer_thread = None
            num_lost = self._num_lost_lines + len(self._queued_lines)
            self._queued_lines.clear()
            self._waiting_bytes = 0
        summary_sentence = f"Recorded: {counted(recording_files.num_frames, 'frame')} in {recording_files.folder}."
        return (
            f"{summary_sentence} Not recorded, for there was no room: {counted(num_lost, 'line')}."
            if num_lost
            else summary_sentence
        )

    def add(self, frame: LiveFrame) -> None:
        """Record a frame. Does nothing if no recording is in progress."""
        if self._recording_files is None:
            return
        frame_values = frame.values
        if isinstance(frame_values, str) or frame_values.ndim != 1:
            self._queue_line(REFUSED, _format_row(frame.second, str(frame_values)))
            return
        if not self._has_usual_length(frame_values):
            self._queue_line(REFUSED, _format_row(frame.second, " ".join(map(repr, frame_values.tolist()))))
            return
        # Readers recognise a column of times by its increase, so each time is at least a microsecond later than the
        # previous time.
        self._last_microsecond = max(round(1e6 * frame.second), self._last_microsecond + 1)
        line = (
            f"{self._last_microsecond / 1e6:.6f},{','.join(map(repr, frame_values.astype(float).tolist()))}\n".encode()
        )
        if self._file_size + len(line) > _MAX_FILE_SIZE:
            self._file_number, self._file_size = self._file_number + 1, 0
        self._file_size += len(line)
        self._queue_line(FRAMES if self._file_number == 1 else f"frames-{self._file_number}.csv", line)

    def _has_usual_length(self, frame_values: np.ndarray) -> bool:
        """Whether a frame has as many channels as the other recorded frames. If the number of channels of the sensor is
        unknown, a new file is begun after three successive frames with a different number of channels."""
        if frame_values.dtype.kind not in "iuf":
            return False
        if self._frame_length is None:
            self._frame_length = len(frame_values)
        if len(frame_values) == self._frame_length:
            self._num_other_lengths = 0
            return True
        self._num_other_lengths += 1
        if self._num_channels is not None or self._num_other_lengths < _NUM_OTHER_LENGTHS:
            return False
        if self._file_size:
            self._file_number, self._file_size = self._file_number + 1, 0
        self._frame_length, self._num_other_lengths = len(frame_values), 0
        return True

    def mark(self, second: float, label: str) -> None:
        """Record an event with the text `label` at the time `second`."""
        if self._recording_files is not None:
            self._queue_line(EVENTS, _format_row(second, label))

    def renew(self, second: float, frames: np.ndarray) -> None:
        """Write the frames (frames, channels) of a new reference to the folder of the recording, and record the change
        of the reference as an event at the time `second`."""
        if self._recording_files is None:
            return
        name = f"reference-{second:.3f}s.npy"
        try:
            np.save(self._recording_files.folder / name, frames)
        except OSError as error:
            self._problem_text = f"The new reference is not recorded: {error.strerror}."
            return
        self.mark(second, f"new reference, {name}")

    def state(self) -> dict[str, Any] | None:
        """Folder of the recording in progress, numbers of frames and bytes written, and problem, if any; None if no
        recording is in progress."""
        with self._queue_condition:
            recording_files = self._recording_files
            if recording_files is None:
                return None
            return {
                "folder": str(recording_files.folder),
                "frames": recording_files.num_frames,
                "bytes": recording_files.num_bytes,
                "problem": self._problem_text or None,
            }

    def _queue_line(self, name: str, line: bytes) -> None:
        with self._queue_condition:
            if self._waiting_bytes + len(line) > _MAX_WAITING_BYTES:
                self._num_lost_lines += 1
                self._problem_text = (
                    f"The disk is full or too slow: {counted(self._num_lost_lines, 'line')} could not be recorded."
                )
                return
            self._queued_lines.append((name, line))
            self._waiting_bytes += len(line)
            self._queue_condition.notify_all()

    def _write_lines(self, recording_files: _RecordingFiles) -> None:
        sync_time = time.monotonic()
        while (queued_line := self._next_line(recording_files)) is not None:
            try:
                recording_files.write(*queued_line)
            except OSError as error:
                with self._queue_condition:
                    if self._is_ending(recording_files):
                        break
                    self._problem_text = _describe_error(error)
                    self._queue_condition.wait_for(lambda: self._is_ending(recording_files), _RETRY_PERIOD)
                continue
            with self._queue_condition:
                if self._recording_files is not recording_files:  # the recording was ended before the line was written
                    break
                self._queued_lines.popleft()
                self._waiting_bytes -= len(queued_line[1])
                if not self._num_lost_lines:
                    self._problem_text = ""
            if time.monotonic() - sync_time > _SYNC_PERIOD:
                recording_files.synchronise()
                sync_time = time.monotonic()
        recording_files.close()

    def _next_line(self, recording_files: _RecordingFiles) -> tuple[str, bytes] | None:
        """Wait for a line to write, and return the line without removing it from the queue; None when the recording
        ends."""
        with self._queue_condition:
            while not self._queued_lines or self._recording_files is not recording_files:
                if self._is_ending(recording_files):
                    return None
                self._queue_condition.wait(_SYNC_PERIOD)
            return self._queued_lines[0]

    def _is_ending(self, recording_files: _RecordingFiles) -> bool:
        return self._is_stopping or self._recording_files is not recording_files


class _RecordingFiles:
    """The files of a recording, each of which always ends with a complete line."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.num_frames = self.num_bytes = 0
        self._file_descriptors: dict[str, int] = {}
        self._file_sizes: dict[str, int] = {}

    def write(self, name: str, line: bytes) -> None:
        """Append a complete line to the file `name`. Raises `OSError` if the line cannot be written; the file is then
        unchanged."""
        if name not in self._file_descriptors:
            self._create_file(name, line)
        self._append_line(self._file_descriptors[name], self._file_sizes[name], line)
        self._file_sizes[name] += len(line)
        self.num_bytes += len(line)
        self.num_frames += name.startswith(_FRAMES_PREFIX)

    def _create_file(self, name: str, line: bytes) -> None:
        """Create the file `name` with its header line, and close the previous file of frames."""
        header_line = b"second,text\n"
        if name.startswith(_FRAMES_PREFIX):
            header_line = (
                "second," + ",".join(f"v{channel_index + 1}" for channel_index in range(line.count(b","))) + "\n"
            ).encode()
        file_descriptor = os.open(self.folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | _BINARY_FILE_FLAG, 0o644)
        try:
            self._append_line(file_descriptor, 0, header_line)
        except OSError:
            os.close(file_descriptor)
            raise
        if name.startswith(_FRAMES_PREFIX):
            for open_file_name in [
                open_file_name for open_file_name in self._file_descriptors if open_file_name.startswith(_FRAMES_PREFIX)
            ]:
                os.close(self._file_descriptors.pop(open_file_name))
        self._file_descriptors[name], self._file_sizes[name] = file_descriptor, len(header_line)

    @staticmethod
    def _append_line(file_descriptor: int, file_size: int, line: bytes) -> None:
        """Append a line to a file of the given `file_size`. If the line cannot be written completely, the file is
        truncated to this size."""
        try:
            num_written = os.write(file_descriptor, line)
            while num_written < len(line):
                num_written += os.write(file_descriptor, line[num_written:])
        except OSError:
            with suppress(OSError):
                os.ftruncate(file_descriptor, file_size)
                os.lseek(file_descriptor, file_size, os.SEEK_SET)
            raise

    def synchronise(self) -> None:
        """Flush all files to the disk."""
        for file_descriptor in self._file_descriptors.values():
            with suppress(OSError):
                os.fsync(file_descriptor)

    def close(self) -> None:
        self.synchronise()
        for file_descriptor in self._file_descriptors.values():
            with suppress(OSError):
                os.close(file_descriptor)
        self._file_descriptors.clear()


def _create_new_folder(folder: Path) -> Path:
    """Create a new folder below `folder`, named by date and time, and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    name = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    for folder_number in range(1, 1000):
        new_folder = folder / (name if folder_number == 1 else f"{name}_{folder_number}")
        with suppress(FileExistsError):
            new_folder.mkdir()
            return new_folder
    raise FileExistsError(errno.EEXIST, "there are a thousand recordings of this second", str(folder))


def _write_reference(reference: Measurement, folder: Path) -> None:
    """Write the reference, and a description with which frames.csv can be read, to `folder`."""
    try:
        _, description = write_table(reference, folder / REFERENCE)
    except ValueError:  # a body that a description cannot express
        reference_without_body = Measurement(
            reference.voltages, reference.mask, reference.protocol, name=reference.name
        )
        _, description = write_table(reference_without_body, folder / REFERENCE)
    text = description.read_text("utf-8")
    (folder / DESCRIPTION).write_text(text, "utf-8")


def _format_row(frame_time: float, text: str) -> bytes:
    """Format a line of a CSV table of times in seconds and texts."""
    text_buffer = io.StringIO()
    csv.writer(text_buffer, lineterminator="\n").writerow([f"{frame_time:.6f}", " ".join(text.split())])
    return text_buffer.getvalue().encode("utf-8", "replace")


def _describe_error(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "The disk is full: frames wait in memory until there is room."
    return f"Frames cannot be written, and wait in memory: {error.strerror or error}."
