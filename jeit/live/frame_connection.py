"""Source of the frames in lines that arrive on a connection (standard input, a serial device, or a TCP server), which
is opened again after a loss; and a source that reads another source ahead in a separate thread."""

from __future__ import annotations

import abc
import os
import queue
import re
import select
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from jeit.arguments.extras import import_optional
from jeit.data.formats.lines import LineBuffer, LineParser
from jeit.live.pictures import LiveFrame
from jeit.live.sources import CONNECTED, ENDED, AbstractSource

_MAX_READ_BYTES = 65536
_ERRNO_PREFIX = re.compile(r"^\[Errno \d+\] ")
# Maximum time in seconds in which a server must answer.
_CONNECT_TIMEOUT = 5.0
_DEFAULT_BAUD, _MAX_BAUD = 115_200, 20_000_000
# Times in seconds: maximum wait for bytes in one read; initial and maximum delay before connecting again, which is
# doubled with each failure; time without data after which a device is reported as silent; minimum interval between
# reported comments of a device.
_READ_TIMEOUT, _INITIAL_DELAY, _MAX_DELAY, _SILENCE_TIMEOUT, _MIN_NOTE_INTERVAL = 0.2, 0.25, 2.0, 3.0, 2.0
# Maximum number of frames that wait until the program reads them.
_MAX_WAITING_FRAMES = 20_000


class AbstractConnection(abc.ABC):
    """Base class of connections that deliver bytes. **Attribute** `reconnects`: whether to connect again when the
    connection is lost."""

    reconnects: bool = True

    @abc.abstractmethod
    def open(self) -> None:
        """Connect. Raises `OSError` if the device does not answer."""

    @abc.abstractmethod
    def read(self, timeout: float) -> bytes | None:
        """Wait for bytes, and return them. Returns b"" if no bytes arrive within `timeout` seconds, and None at the end
        of the data.

        Raises `OSError` if the connection is lost.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Disconnect; does nothing if the connection is not open."""


class StandardInput(AbstractConnection):
    """Connection that delivers the bytes of standard input, or of another open file."""

    reconnects = False

    def __init__(self, descriptor: int | None = None):
        self.descriptor = descriptor

    def open(self) -> None:
        """Connect; see `AbstractConnection.open`."""
        if self.descriptor is None:
            self.descriptor = sys.stdin.fileno()

    def read(self, timeout: float) -> bytes | None:
        """Wait for bytes; see `AbstractConnection.read`."""
        assert self.descriptor is not None, "open first"
        # On other systems `select` accepts only sockets, so the read itself waits for bytes.
        if os.name == "posix" and not select.select([self.descriptor], [], [], timeout)[0]:
            return b""
        return os.read(self.descriptor, _MAX_READ_BYTES) or None

    def close(self) -> None:
        """Do nothing: the program that opened the file closes it."""


class SerialPort(AbstractConnection):
    """Connection to a serial device at `port`, such as /dev/ttyACM0 or COM3, with 8 data bits, no parity and one stop
    bit.

    Raises `ImportError` without pyserial.
    """

    def __init__(self, port: str, baud: int = _DEFAULT_BAUD):
        self.port, self.baud = port, baud
        self.serial = import_optional("serial", "a serial device")
        self.device: Any = None

    def open(self) -> None:
        """Connect; see `AbstractConnection.open`."""
        try:
            self.device = self.serial.Serial(self.port, self.baud, timeout=0.2, exclusive=True)
        except ValueError as error:  # a baud rate that the driver does not support
            raise OSError(str(error)) from None
        except OSError as error:
            port_names = ", ".join(self._list_ports()) or "none"
            message = _ERRNO_PREFIX.sub("", str(error).split(": [Errno")[0])
            raise OSError(f"{message} (serial devices here: {port_names})") from None

    def read(self, timeout: float) -> bytes | None:
        """Wait for bytes; see `AbstractConnection.read`."""
        serial_device = self.device
        try:
            serial_device.timeout = timeout
            first_received_byte = serial_device.read(1)
            return (
                first_received_byte + serial_device.read(min(serial_device.in_waiting, _MAX_READ_BYTES))
                if first_received_byte
                else b""
            )
        except TypeError:  # the port was closed by another thread
            raise OSError("the port was closed") from None

    def close(self) -> None:
        """Disconnect; see `AbstractConnection.close`."""
        serial_device, self.device = self.device, None
        if serial_device is not None:
            with suppress(OSError):
                serial_device.close()

    def _list_ports(self) -> list[str]:
        with suppress(Exception):  # on some systems, devices cannot be listed
            from serial.tools import list_ports

            return sorted(port_info.device for port_info in list_ports.comports())[:8]
        return []


class TcpServer(AbstractConnection):
    """Connection to a TCP server that sends frames to all connected clients."""

    def __init__(self, host: str, port: int):
        self.host, self.port = host, port
        self.socket: socket.socket | None = None

    def open(self) -> None:
        """Connect; see `AbstractConnection.open`."""
        self.socket = socket.create_connection((self.host, self.port), timeout=_CONNECT_TIMEOUT)
        # A server whose cable is unplugged sends nothing, not even the end of the connection.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def read(self, timeout: float) -> bytes | None:
        """Wait for bytes; see `AbstractConnection.read`."""
        assert self.socket is not None, "open first"
        self.socket.settimeout(timeout)
        try:
            return self.socket.recv(_MAX_READ_BYTES) or None
        except TimeoutError:
            return b""

    def close(self) -> None:
        """Disconnect; see `AbstractConnection.close`."""
        if self.socket is not None:
            self.socket.close()
            self.socket = None


def open_connection(text: str) -> AbstractConnection:
    """Create the connection that "-", "serial:PORT@BAUD" or "tcp:HOST:PORT" names. Without "@BAUD", the baud rate is
    115,200.

    Raises `ValueError` for other texts, and `ImportError` for a serial device without pyserial.
    """
    connection_kind, _, connection_address = text.partition(":")
    if text == "-":
        return StandardInput()
    if connection_kind == "serial":
        port_name, _, baud_text = (
            connection_address if "@" in connection_address else f"{connection_address}@{_DEFAULT_BAUD}"
        ).rpartition("@")
        if not port_name or not (
            baud_text.isascii() and baud_text.isdigit() and 0 < len(baud_text) < 9 and 0 < int(baud_text) <= _MAX_BAUD
        ):
            raise ValueError(
                f"source '{text[:80]}': give serial:PORT@BAUD, such as serial:/dev/ttyACM0@115200 or serial:COM3@9600."
            )
        return SerialPort(port_name, int(baud_text))
    host_name, _, port_name = connection_address.rpartition(":")
    host_name = host_name.removeprefix("[").removesuffix("]")
    if not host_name or not (
        port_name.isascii() and port_name.isdigit() and len(port_name) < 6 and 0 < int(port_name) < 65536
    ):
        raise ValueError(f"source '{text[:80]}': give tcp:HOST:PORT, such as tcp:192.168.4.1:5000.")
    return TcpServer(host_name, int(port_name))


class LineSource(AbstractSource):
    """Source of the frames in the lines of a connection.

    A line that is not a frame is delivered as text, which views refuse. Incomplete lines are also delivered as text: a
    line that the loss of the connection cut off, and a line that the device began before the connection was made.
    `rate`: maximum frame rate, frames/s, at which lines that have all arrived already are delivered.
    """

    def __init__(self, name: str, connection: AbstractConnection, reading: LineParser, rate: float | None = None):
        super().__init__(name)
        self.device, self.reading, self.rate = connection, reading, rate
        self._last_note, self._last_note_time = "", -float("inf")

    def end_when_lost(self) -> None:
        """End when the connection is lost; see `AbstractSource.end_when_lost`."""
        self.device.reconnects = False

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        try:
            while self._connect_repeatedly():
                yield from self._read_until_lost()
                if not self.device.reconnects:
                    break
        finally:
            self.device.close()
            self.connection = ENDED

    def _connect_repeatedly(self) -> bool:
        """Try to connect until a connection is made. Returns False if the source is closed before that."""
        retry_delay, last_error_text = _INITIAL_DELAY, ""
        while not self.closing.is_set():
            try:
                self.device.open()
            except OSError as error:
                self.connection = f"waiting: {error}"[:300]
                if str(error) != last_error_text:
                    last_error_text = str(error)
                    self.say(f"Not connected: {error}. Trying again until it is.")
                self.closing.wait(retry_delay)
                retry_delay = min(2 * retry_delay, _MAX_DELAY)
                continue
            if last_error_text or self._num_frames or self.connection != CONNECTED:
                self.say("Connected.")
            self.connection = CONNECTED
            return True
        return False

    def _read_until_lost(self) -> Iterator[LiveFrame]:
        """Yield frames until the connection is lost, the source has ended, or the source is closed."""
        line_buffer, time_of_last_bytes, is_first_line = LineBuffer(), time.monotonic(), self.device.reconnects
        while not self.closing.is_set():
            try:
                received_bytes = self.device.read(_READ_TIMEOUT)
            except OSError as error:
                disconnection_reason = str(error)
                break
            arrival_time = time.monotonic()
            if received_bytes is None:
                disconnection_reason = "the other side has closed the connection"
                break
            if received_bytes:
                time_of_last_bytes, self.connection = arrival_time, CONNECTED
                for line in line_buffer.add_bytes(received_bytes):
                    yield from self._parse_line(line, arrival_time, is_first_line=is_first_line)
                    is_first_line = False
            elif arrival_time - time_of_last_bytes > _SILENCE_TIMEOUT and self.connection == CONNECTED:
                self.connection = "waiting: the device sends nothing"
                self.say("The device is connected and sends nothing.")
        else:
            return
        self.device.close()
        last_line = line_buffer.take_incomplete_line()
        if self.device.reconnects:
            self.connection = f"waiting: {disconnection_reason}"[:300]
            self.say(f"Connection lost: {disconnection_reason}.")
            if last_line.strip():
                yield self.frame(f"cut off: {last_line[:200].decode('utf-8', 'replace')}")
        elif last_line.strip():  # the last line of a file may have no line end
            yield from self._parse_line(last_line, time.monotonic())

    def _parse_line(self, line: bytes, arrival_time: float, *, is_first_line: bool = False) -> Iterator[LiveFrame]:
        """Yield the frame in a line, if the line is not a comment. `is_first_line`: whether the connection may have
        begun within the line."""
        frame_values = self.reading(line)
        parser_note = self.reading.note
        if (
            parser_note
            and parser_note != self._last_note
            and (frame_values is not None or arrival_time - self._last_note_time > _MIN_NOTE_INTERVAL)
        ):
            self._last_note, self._last_note_time = parser_note, arrival_time
            self.say(parser_note if frame_values is not None else f"The device sends: {parser_note}")
        if frame_values is None:
            return
        if (
            is_first_line
            and not isinstance(frame_values, str)
            and not self.reading.starts_with_complete_number(frame_values)
        ):
            frame_values = f"begun before connecting: {line[:200].decode('utf-8', 'replace')}"
        if self.rate is not None:
            scheduled_frame_time = self.begun + self._num_frames / self.rate
            if self.closing.wait(max(0.0, scheduled_frame_time - time.monotonic())):
                return
            arrival_time = time.monotonic()
        yield self.frame(frame_values, arrival_time)


class ReadAhead(AbstractSource):
    """Source that reads another source in a separate thread, so that frames keep the time of their arrival, and no
    frame is lost, while a program prepares to image them. At most 20,000 frames wait; the loss of later frames is
    reported.
    """

    def __init__(self, source: AbstractSource):
        self._source = source
        self._frame_queue: queue.Queue[LiveFrame | BaseException | None] = queue.Queue()
        threading.Thread(target=self._read_source, name="jeit live ahead", daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def __iter__(self) -> Iterator[LiveFrame]:
        while (frame := self._frame_queue.get()) is not None:
            if isinstance(frame, BaseException):
                raise frame
            if self._source.closing.is_set():
                return
            yield frame

    def close(self) -> None:
        """End the iteration soon, and discard the waiting frames."""
        self._source.close()
        self._frame_queue.put(None)

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
                if self._frame_queue.qsize() >= _MAX_WAITING_FRAMES:
                    num_lost += 1
                    continue
                report_loss()
                num_lost = 0
                self._frame_queue.put(frame)
        except Exception as error:  # raised again in the thread that iterates over the frames
            self._frame_queue.put(error)
        report_loss()
        self._frame_queue.put(None)
