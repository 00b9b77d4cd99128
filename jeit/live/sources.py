"""Sources of frames: what every source has, and the one that a text such as `serial:/dev/ttyACM0@115200` names."""

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
# Number of messages that are kept, and characters of each.
MESSAGES, _LONGEST = 50, 300
# Frame rate of a recording without times, in frames/s.
_USUAL_RATE = 10.0


class AbstractSource(abc.ABC):
    """Base class of sources of frames. A source is iterated once, by one thread; `close` may be called by any thread.

    **Arguments:**

    - `name`: what the user gave, for messages.

    **Attributes**: `name`; `connection`: "connected", "waiting: …" with the reason, or "ended"; `begun`:
    `time.monotonic()` of second 0; `messages`: the last 50 reports about the connection, as pairs of second and
    sentence.

    **Example:**

    ```python
    source = open_source("demo")
    print(isinstance(source, AbstractSource), source.connection)
    ```
    """

    def __init__(self, name: str):
        self.name, self.connection = name, CONNECTED
        self.begun = time.monotonic()
        self.messages: deque[tuple[float, str]] = deque(maxlen=MESSAGES)
        self.closing = threading.Event()
        self._number = 0

    @abc.abstractmethod
    def __iter__(self) -> Iterator[LiveFrame]:
        """Frames as they arrive; ends when the source has ended or is closed."""

    def close(self) -> None:
        """End the iteration soon, also while it waits for a device."""
        self.closing.set()

    def end_when_lost(self) -> None:
        """End when a connection is lost, instead of waiting for it; sources without connections end anyway."""
        return

    def say(self, sentence: str) -> None:
        """Keep a report about the source, with its time."""
        self.messages.append((time.monotonic() - self.begun, sentence[:_LONGEST]))

    def frame(self, values: np.ndarray | str, arrived: float | None = None) -> LiveFrame:
        """The next frame, numbered. `arrived`: `time.monotonic()` of its last byte, by default now."""
        arrived = time.monotonic() if arrived is None else arrived
        made = LiveFrame(self._number, arrived - self.begun, arrived, values)
        self._number += 1
        return made


class PlayedRecording(AbstractSource):
    """Frames (F, M) of a recording, played at their `times` (F,), seconds, at `rate` frames/s, or else at ten
    frames/s."""

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
            self.say(f"The recording has no times: it is played at {_USUAL_RATE:g} frames a second; see --rate.")
            rate = _USUAL_RATE
        if rate is not None or times is None:
            self.seconds = np.arange(len(self.frames)) / (rate or _USUAL_RATE)
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
    """The source that a text names.

    - "-": lines on standard input. "serial:PORT@BAUD": lines of a serial device. "tcp:HOST:PORT": lines of a server.
    - a folder: files that an instrument writes into it, a frame or more in each; those that are there already are left
      out, unless a `rate` is given. A file: a recording, played at its own rate.
    - "demo": a simulated tank in which a rod goes round; "demo:skin": a simulated skin that is stroked.

    **Arguments:**

    - `text`: the text.
    - `rate`: frames/s of a recording or of lines that have all arrived already.
    - `description`: what numbers mean, as `description` of `jeit.data.read`.
    - `reference`: a measurement of the undisturbed sensor, as `like` of `jeit.data.read`.

    Raises `ValueError` for a text that names no source and for a rate that is not positive, and as `jeit.data.read` for
    a recording.

    **Example:**

    ```python
    source = open_source("demo:skin", rate=100.0)
    print(next(iter(source)).values.shape)
    ```
    """
    if rate is not None and not (is_number(rate) and 0 < rate < float("inf")):
        raise ValueError(f"rate must be positive, frames in a second; it is {describe(rate)}.")
    if text == "demo" or text.startswith("demo:"):
        from jeit.live.simulated import simulated

        return simulated(text, rate)
    kind = text.partition(":")[0]
    if text == "-" or kind in ("serial", "tcp"):
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
