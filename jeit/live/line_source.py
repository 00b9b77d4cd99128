"""Frames from lines of a connection, which is made again whenever it is lost, and frames that are read ahead."""

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

# Seconds of waiting for bytes at a time, before connecting again (doubled with each failure), without any byte until
# that is reported, and between comments of a device that are reported.
_WAIT, _FIRST_DELAY, _LONGEST_DELAY, _SILENT, _BETWEEN = 0.2, 0.25, 2.0, 3.0, 2.0
# Maximum number of frames that wait for a program that does not read them yet.
_MAX_AHEAD = 20_000


class LineSource(AbstractSource):
    """Frames from the lines of a connection.

    A line that is no frame is delivered as text, to be refused; so are what is left of a line when a connection is
    lost, and what comes first from a device that was in the middle of a line. `rate`: frames/s at most, for lines that
    have all arrived already.
    """

    def __init__(self, name: str, connection: AbstractConnection, reading: LineReading, rate: float | None = None):
        super().__init__(name)
        self.device, self.reading, self.rate = connection, reading, rate
        self._note, self._noted = "", -float("inf")

    def end_when_lost(self) -> None:
        """End when the connection is lost; see `AbstractSource.end_when_lost`."""
        self.device.lasting = False

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        try:
            while self._connect():
                yield from self._until_lost()
                if not self.device.lasting:
                    break
        finally:
            self.device.close()
            self.connection = ENDED

    def _connect(self) -> bool:
        """Connect, as often as is needed; False if closed before."""
        delay, failed = _FIRST_DELAY, ""
        while not self.closing.is_set():
            try:
                self.device.open()
            except OSError as error:
                self.connection = f"waiting: {error}"[:300]
                if str(error) != failed:
                    failed = str(error)
                    self.say(f"Not connected: {error}. Trying again until it is.")
                self.closing.wait(delay)
                delay = min(2 * delay, _LONGEST_DELAY)
                continue
            if failed or self._number or self.connection != CONNECTED:
                self.say("Connected.")
            self.connection = CONNECTED
            return True
        return False

    def _until_lost(self) -> Iterator[LiveFrame]:
        """Frames until the connection is lost, or the source has ended or is closed."""
        buffer, last, first = LineBuffer(), time.monotonic(), self.device.lasting
        while not self.closing.is_set():
            try:
                piece = self.device.read(_WAIT)
            except OSError as error:
                lost = str(error)
                break
            arrived = time.monotonic()
            if piece is None:
                lost = "the other side has closed the connection"
                break
            if piece:
                last, self.connection = arrived, CONNECTED
                for line in buffer.feed(piece):
                    yield from self._frames(line, arrived, first=first)
                    first = False
            elif arrived - last > _SILENT and self.connection == CONNECTED:
                self.connection = "waiting: the device sends nothing"
                self.say("The device is connected and sends nothing.")
        else:
            return
        self.device.close()
        rest = buffer.rest()
        if self.device.lasting:
            self.connection = f"waiting: {lost}"[:300]
            self.say(f"Connection lost: {lost}.")
            if rest.strip():
                yield self.frame(f"cut off: {rest[:200].decode('utf-8', 'replace')}")
        elif rest.strip():  # the last line of a file may lack its end
            yield from self._frames(rest, time.monotonic())

    def _frames(self, line: bytes, arrived: float, *, first: bool = False) -> Iterator[LiveFrame]:
        """The frame in a line, if there is one. `first`: whether the device may have been in the middle of the line."""
        values = self.reading(line)
        note = self.reading.note
        if note and note != self._note and (values is not None or arrived - self._noted > _BETWEEN):
            self._note, self._noted = note, arrived
            self.say(note if values is not None else f"The device sends: {note}")
        if values is None:
            return
        if first and not isinstance(values, str) and not self.reading.begins_whole(values):
            values = f"begun before connecting: {line[:200].decode('utf-8', 'replace')}"
        if self.rate is not None:
            due = self.begun + self._number / self.rate
            if self.closing.wait(max(0.0, due - time.monotonic())):
                return
            arrived = time.monotonic()
        yield self.frame(values, arrived)


class ReadAhead(AbstractSource):
    """A source that a thread of its own reads from now on, so that frames keep the time of their arrival, and none is
    lost, while a program prepares to image them. At most 20,000 frames wait; the loss of later ones is reported.
    """

    def __init__(self, source: AbstractSource):
        self._source = source
        self._waiting: queue.Queue[LiveFrame | BaseException | None] = queue.Queue()
        threading.Thread(target=self._read, name="jeit live ahead", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def __iter__(self) -> Iterator[LiveFrame]:
        while (frame := self._waiting.get()) is not None:
            if isinstance(frame, BaseException):
                raise frame
            if self._source.closing.is_set():
                return
            yield frame

    def close(self) -> None:
        """End the iteration soon, without the frames that wait."""
        self._source.close()
        self._waiting.put(None)

    def end_when_lost(self) -> None:
        """End when the connection is lost; see `AbstractSource.end_when_lost`."""
        self._source.end_when_lost()

    def _read(self) -> None:
        num_lost = 0
        try:
            for frame in self._source:
                if self._waiting.qsize() >= _MAX_AHEAD:
                    num_lost += 1
                    continue
                if num_lost:
                    self._source.say(f"{num_lost} frames were lost: the program did not read them.")
                    num_lost = 0
                self._waiting.put(frame)
        except Exception as error:  # raised where the frames are read
            self._waiting.put(error)
        self._waiting.put(None)
