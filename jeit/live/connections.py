"""Connections that deliver bytes: standard input, a serial device, and a server; the last two may be lost and found."""

from __future__ import annotations

import abc
import os
import re
import select
import socket
import sys
from contextlib import suppress
from typing import Any

from jeit.arguments.extras import optional

_PIECE = 65536
_NUMBER = re.compile(r"^\[Errno \d+\] ")
# Seconds for which a server may take to answer.
_ANSWER = 5.0
_BAUD, _MOST_BAUD = 115_200, 20_000_000


class AbstractConnection(abc.ABC):
    """Bytes of a device. **Attribute** `lasting`: whether to connect again once the connection is lost."""

    lasting: bool = True

    @abc.abstractmethod
    def open(self) -> None:
        """Connect. Raises `OSError` if that fails now."""

    @abc.abstractmethod
    def read(self, timeout: float) -> bytes | None:
        """Bytes as soon as some are there; empty if none come within `timeout` seconds; None at the end.

        Raises `OSError` if the connection is lost.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Disconnect; does nothing if there is no connection."""


class StandardInput(AbstractConnection):
    """Bytes of standard input, or of another open file."""

    lasting = False

    def __init__(self, descriptor: int | None = None):
        self.descriptor = descriptor

    def open(self) -> None:
        """Connect; see `AbstractConnection.open`."""
        if self.descriptor is None:
            self.descriptor = sys.stdin.fileno()

    def read(self, timeout: float) -> bytes | None:
        """Wait for bytes; see `AbstractConnection.read`."""
        assert self.descriptor is not None, "open first"
        # Elsewhere only sockets can be waited for: reading waits for bytes.
        if os.name == "posix" and not select.select([self.descriptor], [], [], timeout)[0]:
            return b""
        return os.read(self.descriptor, _PIECE) or None

    def close(self) -> None:
        """Leave it open: it is not ours."""


class SerialPort(AbstractConnection):
    """A serial device at `port`, such as /dev/ttyACM0 or COM3, with 8 data bits, no parity and one stop bit.

    Raises `ImportError` without pyserial.
    """

    def __init__(self, port: str, baud: int = _BAUD):
        self.port, self.baud = port, baud
        self.serial = optional("serial", "a serial device")
        self.device: Any = None

    def open(self) -> None:
        """Connect; see `AbstractConnection.open`."""
        try:
            self.device = self.serial.Serial(self.port, self.baud, timeout=0.2, exclusive=True)
        except ValueError as error:  # a rate that the driver does not know
            raise OSError(str(error)) from None
        except OSError as error:
            others = ", ".join(self._others()) or "none"
            said = _NUMBER.sub("", str(error).split(": [Errno")[0])
            raise OSError(f"{said} (serial devices here: {others})") from None

    def read(self, timeout: float) -> bytes | None:
        """Wait for bytes; see `AbstractConnection.read`."""
        device = self.device
        try:
            device.timeout = timeout
            first = device.read(1)
            return first + device.read(min(device.in_waiting, _PIECE)) if first else b""
        except TypeError:  # closed by another thread
            raise OSError("the port was closed") from None

    def close(self) -> None:
        """Disconnect; see `AbstractConnection.close`."""
        device, self.device = self.device, None
        if device is not None:
            with suppress(OSError):
                device.close()

    def _others(self) -> list[str]:
        with suppress(Exception):  # a system whose devices cannot be listed
            from serial.tools import list_ports

            return sorted(one.device for one in list_ports.comports())[:8]
        return []


class Server(AbstractConnection):
    """A TCP server that sends frames to whoever connects."""

    def __init__(self, host: str, port: int):
        self.host, self.port = host, port
        self.socket: socket.socket | None = None

    def open(self) -> None:
        """Connect; see `AbstractConnection.open`."""
        self.socket = socket.create_connection((self.host, self.port), timeout=_ANSWER)
        # A server whose cable is unplugged sends nothing, not even an end.
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def read(self, timeout: float) -> bytes | None:
        """Wait for bytes; see `AbstractConnection.read`."""
        assert self.socket is not None, "open first"
        self.socket.settimeout(timeout)
        try:
            return self.socket.recv(_PIECE) or None
        except TimeoutError:
            return b""

    def close(self) -> None:
        """Disconnect; see `AbstractConnection.close`."""
        if self.socket is not None:
            self.socket.close()
            self.socket = None


def connection_to(text: str) -> AbstractConnection:
    """The connection that "-", "serial:PORT@BAUD" or "tcp:HOST:PORT" names; without "@BAUD", 115,200.

    Raises `ValueError` for other texts, and `ImportError` for a serial device without pyserial.
    """
    kind, _, rest = text.partition(":")
    if text == "-":
        return StandardInput()
    if kind == "serial":
        port, _, baud = (rest if "@" in rest else f"{rest}@{_BAUD}").rpartition("@")
        if not port or not (baud.isascii() and baud.isdigit() and 0 < len(baud) < 9 and 0 < int(baud) <= _MOST_BAUD):
            raise ValueError(
                f"source '{text[:80]}': give serial:PORT@BAUD, such as serial:/dev/ttyACM0@115200 or serial:COM3@9600."
            )
        return SerialPort(port, int(baud))
    host, _, port = rest.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit() and len(port) < 6 and 0 < int(port) < 65536):
        raise ValueError(f"source '{text[:80]}': give tcp:HOST:PORT, such as tcp:192.168.4.1:5000.")
    return Server(host, int(port))
