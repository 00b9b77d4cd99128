"""Sources of frames: the base class, recordings, files that an instrument writes into a folder, and a function that
opens the source named by a text such as `serial:/dev/ttyACM0@115200`."""

from __future__ import annotations

import abc
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jeit.arguments import counted, describe, is_number
from jeit.data import Measurement, read
from jeit.imaging.stream_preparation import frames_of
from jeit.live.pictures import LiveFrame

ENDED, CONNECTED = "ended", "connected"
# Maximum number of stored messages, and maximum number of characters of a message.
MAX_MESSAGES, _MAX_MESSAGE_LENGTH = 50, 300
# Frame rate of a recording without times, in frames/s.
_DEFAULT_RATE = 10.0
# Minimum pause in seconds between two listings of the folder.
_MIN_PAUSE = 0.02
# Minimum ratio of the pause to the duration of a listing, for folders of many files.
_PAUSE_FACTOR = 4.0
# Time in seconds after which an unreadable file is refused (earlier, the instrument may still be writing it).
_READ_TIMEOUT = 2.0


class AbstractSource(abc.ABC):
    """Base class of sources of frames. One thread iterates over a source, once; any thread may call `close`.

    **Arguments:**

    - `name`: name of the source as the user gave it, for messages.

    **Attributes**: `name`; `connection`: "connected", "waiting: …" with the reason, or "ended"; `begun`:
    `time.monotonic()` at the beginning of the session (second 0); `messages`: the last 50 reports about the connection,
    as pairs of time in seconds and sentence.

    **Example:**

    ```python
    source = open_source("demo")
    print(isinstance(source, AbstractSource), source.connection)
    ```
    """

    def __init__(self, name: str):
        self.name, self.connection = name, CONNECTED
        self.begun = time.monotonic()
        self.messages: deque[tuple[float, str]] = deque(maxlen=MAX_MESSAGES)
        self.closing = threading.Event()
        self._num_frames = 0

    @abc.abstractmethod
    def __iter__(self) -> Iterator[LiveFrame]:
        """Yield frames as they arrive, until the source has ended or is closed."""

    def close(self) -> None:
        """End the iteration over frames soon, even while it waits for a device."""
        self.closing.set()

    def end_when_lost(self) -> None:
        """Make the source end when the connection is lost, instead of connecting again. Sources without a connection
        end in any case."""
        return

    def say(self, sentence: str) -> None:
        """Add `sentence`, a report about the source, to the messages, with the present time."""
        self.messages.append((time.monotonic() - self.begun, sentence[:_MAX_MESSAGE_LENGTH]))

    def frame(self, values: np.ndarray | str, arrived: float | None = None) -> LiveFrame:
        """Create the next frame of the source, with the next number. `arrived`: `time.monotonic()` when the frame's
        last byte was read, by default now."""
        arrived = time.monotonic() if arrived is None else arrived
        new_frame = LiveFrame(self._num_frames, arrived - self.begun, arrived, values)
        self._num_frames += 1
        return new_frame


class PlayedRecording(AbstractSource):
    """Source that plays the `frames` (frames, channels) of a recording: at `rate` frames/s if given, otherwise at
    `times` (frames,) in seconds if given, otherwise at ten frames/s."""

    def __init__(
        self,
        name: str,
        frames: Float[np.ndarray, "F M"],
        times: Float[np.ndarray, " F"] | None = None,
        rate: float | None = None,
    ):
        super().__init__(name)
        self.frames = np.asarray(frames)
        if rate is None and times is None:
            self.say(f"The recording has no times: it is played at {_DEFAULT_RATE:g} frames a second; see --rate.")
            rate = _DEFAULT_RATE
        if rate is not None or times is None:
            self.seconds = np.arange(len(self.frames)) / (rate or _DEFAULT_RATE)
        else:
            self.seconds = np.asarray(times) - float(times[0])

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        for frame_second, frame_values in zip(self.seconds.tolist(), self.frames, strict=True):
            if self.closing.wait(max(0.0, self.begun + frame_second - time.monotonic())):
                break
            yield self.frame(frame_values)
        self.connection = ENDED


class WatchedFolder(AbstractSource):
    """Source of the frames in files that appear in a folder, in the order of file names. Files that already exist are
    left out, unless a `rate` in frames/s is given.

    A file is read when its size is the same in two successive listings of the folder. `description`, `reference`: as
    `description` and `like` of `jeit.data.read`. For a file that cannot be read, the source yields a frame with the
    error message instead of values, which views refuse.
    """

    def __init__(
        self,
        folder: Path,
        description: str | Path | None = None,
        reference: Measurement | None = None,
        rate: float | None = None,
    ):
        super().__init__(str(folder))
        self.folder, self.description, self.reference, self.rate = folder, description, reference, rate
        self._known_names = set() if rate is not None else set(self._list_sizes())
        self._pending_files: dict[str, tuple[int, float]] = {}
        if self._known_names:
            self.say(
                f"Left out: {counted(len(self._known_names), 'file')} that were in the folder before; --rate plays "
                "them, too."
            )

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        pause_duration = _MIN_PAUSE
        while not self.closing.wait(pause_duration):
            start_time = time.monotonic()
            try:
                file_sizes = self._list_sizes()
            except OSError as error:
                if self.connection == CONNECTED:
                    self.connection = f"waiting: {error}"[:300]
                    self.say(f"The folder cannot be read: {error}.")
                continue
            pause_duration = max(_MIN_PAUSE, _PAUSE_FACTOR * (time.monotonic() - start_time))
            if self.connection != CONNECTED:
                self.connection = CONNECTED
                self.say("The folder can be read again.")
            self._known_names &= file_sizes.keys()
            for name in [name for name in self._pending_files if name not in file_sizes]:
                del self._pending_files[name]
            for name in sorted(file_sizes.keys() - self._known_names):
                yield from self._read_file(name, file_sizes[name])
        self.connection = ENDED

    def _list_sizes(self) -> dict[str, int]:
        """Sizes of the files in the folder by name. Hidden and temporary files are left out, because programs write
        such files first and then rename them."""
        with os.scandir(self.folder) as folder_entries:
            file_sizes = {}
            for folder_entry in folder_entries:
                try:
                    if (
                        not folder_entry.name.startswith(".")
                        and not folder_entry.name.endswith((".toml", ".part", ".tmp"))
                        and folder_entry.is_file()
                    ):
                        file_sizes[folder_entry.name] = folder_entry.stat().st_size
                except OSError:  # the file was removed after the listing
                    continue
            return file_sizes

    def _read_file(self, name: str, file_size: int) -> Iterator[LiveFrame]:
        """Yield the frames of a file if the file is complete."""
        previous_file_size, time_of_size = self._pending_files.get(name, (-1, time.monotonic()))
        if file_size != previous_file_size:
            time_of_size = time.monotonic()
        self._pending_files[name] = file_size, time_of_size
        if file_size != previous_file_size or not file_size:
            return
        try:
            file_measurement = read(self.folder / name, description=self.description, like=self.reference)
            frames = frames_of(file_measurement)
            if frames.dtype.kind == "c":
                raise ValueError(f"{name}: the voltages are complex; choose a part with [data] component.")
        except (ValueError, OSError) as error:
            if time.monotonic() - time_of_size < _READ_TIMEOUT:
                return
            self._mark_as_read(name)
            yield self.frame(f"{error}"[:400])
            return
        self._mark_as_read(name)
        for frame_values in frames:
            if self.rate is not None:
                scheduled_frame_time = self.begun + self._num_frames / self.rate
                if self.closing.wait(max(0.0, scheduled_frame_time - time.monotonic())):
                    return
            yield self.frame(frame_values)

    def _mark_as_read(self, name: str) -> None:
        self._pending_files.pop(name, None)
        self._known_names.add(name)


def open_source(
    text: str,
    *,
    rate: float | None = None,
    description: str | Path | None = None,
    reference: Measurement | None = None,
) -> AbstractSource:
    """Open the source of frames that `text` names.

    - "-": lines on standard input. "serial:PORT@BAUD": lines of a serial device. "tcp:HOST:PORT": lines of a server.
    - a folder: files that an instrument writes into the folder, each with one or more frames; files that already exist
      are left out, unless a `rate` is given. A file: a recording, played at its own frame rate.
    - "demo": a simulated tank in which a rod moves on a circle; "demo:skin": a simulated skin that is stroked.

    **Arguments:**

    - `text`: name of the source, as listed above.
    - `rate`: frames/s at which a recording, or lines that have all arrived already, are played.
    - `description`: description of the frames, as `description` of `jeit.data.read`.
    - `reference`: a measurement of the undisturbed sensor, as `like` of `jeit.data.read`.

    Raises `ValueError` for a text that does not name a source, for a rate that is not positive, and for a recording
    that `jeit.data.read` cannot read.

    **Example:**

    ```python
    source = open_source("demo:skin", rate=100.0)
    print(next(iter(source)).values.shape)
    ```
    """
    if rate is not None and not (is_number(rate) and 0 < rate < float("inf")):
        raise ValueError(f"rate must be positive, frames in a second; it is {describe(rate)}.")
    if text == "demo" or text.startswith("demo:"):
        from jeit.live.simulated import open_simulated

        return open_simulated(text, rate)
    address_scheme = text.partition(":")[0]
    if text == "-" or address_scheme in ("serial", "tcp"):
        from jeit.data.formats.lines import LineParser
        from jeit.live.frame_connection import LineSource, ReadAhead, open_connection

        return ReadAhead(LineSource(text, open_connection(text), LineParser(description, reference), rate))
    path = Path(text)
    if text and path.is_dir():
        return WatchedFolder(path, description, reference, rate)
    if path.is_file():
        recorded_measurement = read(path, description=description, like=reference)
        frame_times = None if recorded_measurement.times is None else np.asarray(recorded_measurement.times)
        return PlayedRecording(text, frames_of(recorded_measurement), frame_times, rate)
    raise ValueError(
        f"source: there is no file or folder '{text[:80]}'. Give one, - for standard input, serial:PORT@BAUD, "
        "tcp:HOST:PORT, or demo."
    )
