"""Sources of frames: the base class, recordings, and opening of a source by a text such as
`serial:/dev/ttyACM0@115200`."""

from __future__ import annotations

import abc
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jeit.arguments import describe, is_number
from jeit.data import Measurement, read
from jeit.imaging.stream_preparation import frames_of
from jeit.live.pictures import LiveFrame

ENDED, CONNECTED = "ended", "connected"
# Maximum number of messages that are kept, and maximum number of characters of a message.
MAX_MESSAGES, _MAX_MESSAGE_LENGTH = 50, 300
# Frame rate of a recording without times, in frames/s.
_DEFAULT_RATE = 10.0


class AbstractSource(abc.ABC):
    """Base class of sources of frames. A source is iterated once, by one thread; `close` may be called by any thread.

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
        for second, values in zip(self.seconds.tolist(), self.frames, strict=True):
            if self.closing.wait(max(0.0, self.begun + second - time.monotonic())):
                break
            yield self.frame(values)
        self.connection = ENDED


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
    scheme = text.partition(":")[0]
    if text == "-" or scheme in ("serial", "tcp"):
        from jeit.live.connections import connection_to
        from jeit.live.line_source import LineSource, ReadAhead
        from jeit.live.lines import LineReading

        return ReadAhead(LineSource(text, connection_to(text), LineReading(description, reference), rate))
    path = Path(text)
    if text and path.is_dir():
        from jeit.live.folder_source import WatchedFolder

        return WatchedFolder(path, description, reference, rate)
    if path.is_file():
        measured = read(path, description=description, like=reference)
        times = None if measured.times is None else np.asarray(measured.times)
        return PlayedRecording(text, frames_of(measured), times, rate)
    raise ValueError(
        f"source: there is no file or folder '{text[:80]}'. Give one, - for standard input, serial:PORT@BAUD, "
        "tcp:HOST:PORT, or demo."
    )
