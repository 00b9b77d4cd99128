"""Two sources of frames: lines that arrive on a connection, which is made again if it is lost; and another source that
is read ahead in a separate thread."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from typing import Any

from jeit.live.connections import AbstractConnection
from jeit.live.lines import LineBuffer, LineReading
from jeit.live.pictures import LiveFrame
from jeit.live.sources import CONNECTED, ENDED, AbstractSource

# Times in seconds: maximum wait for bytes in one read; initial and maximum delay before connecting again, which is
# doubled with each failure; time without data after which a device is reported as silent; minimum interval between
# reported comments of a device.
_READ_TIMEOUT, _INITIAL_DELAY, _MAX_DELAY, _SILENCE_TIMEOUT, _MIN_NOTE_INTERVAL = 0.2, 0.25, 2.0, 3.0, 2.0
# Maximum number of frames that wait until the program reads them.
_MAX_AHEAD = 20_000


class LineSource(AbstractSource):
    """Source of the frames in the lines of a connection.

    A line that is not a frame is delivered as text, which views refuse. Incomplete lines are also delivered as text: a
    line that the loss of the connection cut off, and a line that the device began before the connection was made.
    `rate`: maximum number of frames/s, for lines that have all arrived already.
    """

    def __init__(self, name: str, connection: AbstractConnection, reading: LineReading, rate: float | None = None):
        super().__init__(name)
        self.device, self.reading, self.rate = connection, reading, rate
        self._last_note, self._note_time = "", -float("inf")

    def end_when_lost(self) -> None:
        """End when the connection is lost; see `AbstractSource.end_when_lost`."""
        self.device.reconnects = False

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        try:
            while self._connect():
                yield from self._read_until_lost()
                if not self.device.reconnects:
                    break
        finally:
            self.device.close()
            self.connection = ENDED

    def _connect(self) -> bool:
        """Try to connect until a connection is made. Returns False if the source is closed before that."""
        delay, last_error = _INITIAL_DELAY, ""
        while not self.closing.is_set():
            try:
                self.device.open()
            except OSError as error:
                self.connection = f"waiting: {error}"[:300]
                if str(error) != last_error:
                    last_error = str(error)
                    self.say(f"Not connected: {error}. Trying again until it is.")
                self.closing.wait(delay)
                delay = min(2 * delay, _MAX_DELAY)
                continue
            if last_error or self._num_frames or self.connection != CONNECTED:
                self.say("Connected.")
            self.connection = CONNECTED
            return True
        return False

    def _read_until_lost(self) -> Iterator[LiveFrame]:
        """Yield frames until the connection is lost, the source has ended, or the source is closed."""
        buffer, last_arrival, is_first = LineBuffer(), time.monotonic(), self.device.reconnects
        while not self.closing.is_set():
            try:
                received = self.device.read(_READ_TIMEOUT)
            except OSError as error:
                loss_reason = str(error)
                break
            arrived = time.monotonic()
            if received is None:
                loss_reason = "the other side has closed the connection"
                break
            if received:
                last_arrival, self.connection = arrived, CONNECTED
                for line in buffer.feed(received):
                    yield from self._parse_line(line, arrived, is_first=is_first)
                    is_first = False
            elif arrived - last_arrival > _SILENCE_TIMEOUT and self.connection == CONNECTED:
                self.connection = "waiting: the device sends nothing"
                self.say("The device is connected and sends nothing.")
        else:
            return
        self.device.close()
        remainder = buffer.take_remainder()
        if self.device.reconnects:
            self.connection = f"waiting: {loss_reason}"[:300]
            self.say(f"Connection lost: {loss_reason}.")
            if remainder.strip():
                yield self.frame(f"cut off: {remainder[:200].decode('utf-8', 'replace')}")
        elif remainder.strip():  # the last line of a file may have no line end
            yield from self._parse_line(remainder, time.monotonic())

    def _parse_line(self, line: bytes, arrived: float, *, is_first: bool = False) -> Iterator[LiveFrame]:
        """Yield the frame in a line, if the line is not a comment. `is_first`: whether the connection may have begun
        within the line."""
        values = self.reading(line)
        note = self.reading.note
        if note and note != self._last_note and (values is not None or arrived - self._note_time > _MIN_NOTE_INTERVAL):
            self._last_note, self._note_time = note, arrived
            self.say(note if values is not None else f"The device sends: {note}")
        if values is None:
            return
        if is_first and not isinstance(values, str) and not self.reading.begins_whole(values):
            values = f"begun before connecting: {line[:200].decode('utf-8', 'replace')}"
        if self.rate is not None:
            due_time = self.begun + self._num_frames / self.rate
            if self.closing.wait(max(0.0, due_time - time.monotonic())):
                return
            arrived = time.monotonic()
        yield self.frame(values, arrived)


class ReadAhead(AbstractSource):
    """Source that reads another source in a separate thread, so that frames keep the time of their arrival, and no
    frame is lost, while a program prepares to image them. At most 20,000 frames wait; the loss of later frames is
    reported.
    """

    def __init__(self, source: AbstractSource):
        self._source = source
        self._queue: queue.Queue[LiveFrame | BaseException | None] = queue.Queue()
        threading.Thread(target=self._read_source, name="jeit live ahead", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def __iter__(self) -> Iterator[LiveFrame]:
        while (frame := self._queue.get()) is not None:
            if isinstance(frame, BaseException):
                raise frame
            if self._source.closing.is_set():
                return
            yield frame

    def close(self) -> None:
        """End the iteration soon, and discard the waiting frames."""
        self._source.close()
        self._queue.put(None)

    def end_when_lost(self) -> None:
        """End when the connection is lost; see `AbstractSource.end_when_lost`."""
        self._source.end_when_lost()

    def _read_source(self) -> None:
        num_lost = 0

        def report_loss() -> None:
            if num_lost:
                self._source.say(f"{num_lost} frames were lost: the program did not read them.")

        try:
            for frame in self._source:
                if self._queue.qsize() >= _MAX_AHEAD:
                    num_lost += 1
                    continue
                report_loss()
                num_lost = 0
                self._queue.put(frame)
        except Exception as error:  # raised where the frames are read
            self._queue.put(error)
        report_loss()
        self._queue.put(None)
