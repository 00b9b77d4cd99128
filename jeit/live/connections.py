"""Connections that deliver bytes: standard input, a serial device, and a TCP server. Lost connections to a device or
server are made again."""

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

_MAX_READ_BYTES = 65536
_ERRNO_PREFIX = re.compile(r"^\[Errno \d+\] ")
# Maximum time in seconds in which a server must answer.
_CONNECT_TIMEOUT = 5.0
_DEFAULT_BAUD, _MAX_BAUD = 115_200, 20_000_000


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
        self.serial = optional("serial", "a serial device")
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
        device = self.device
        try:
            device.timeout = timeout
            first = device.read(1)
            return first + device.read(min(device.in_waiting, _MAX_READ_BYTES)) if first else b""
        except TypeError:  # the port was closed by another thread
            raise OSError("the port was closed") from None

    def close(self) -> None:
        """Disconnect; see `AbstractConnection.close`."""
        device, self.device = self.device, None
        if device is not None:
            with suppress(OSError):
                device.close()

    def _list_ports(self) -> list[str]:
        with suppress(Exception):  # on some systems, devices cannot be listed
            from serial.tools import list_ports

            return sorted(port_info.device for port_info in list_ports.comports())[:8]
        return []


class Server(AbstractConnection):
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


def connection_to(text: str) -> AbstractConnection:
    """Create the connection that "-", "serial:PORT@BAUD" or "tcp:HOST:PORT" names. Without "@BAUD", the baud rate is
    115,200.

    Raises `ValueError` for other texts, and `ImportError` for a serial device without pyserial.
    """
    kind, _, address = text.partition(":")
    if text == "-":
        return StandardInput()
    if kind == "serial":
        port, _, baud = (address if "@" in address else f"{address}@{_DEFAULT_BAUD}").rpartition("@")
        if not port or not (baud.isascii() and baud.isdigit() and 0 < len(baud) < 9 and 0 < int(baud) <= _MAX_BAUD):
            raise ValueError(
                f"source '{text[:80]}': give serial:PORT@BAUD, such as serial:/dev/ttyACM0@115200 or serial:COM3@9600."
            )
        return SerialPort(port, int(baud))
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit() and len(port) < 6 and 0 < int(port) < 65536):
        raise ValueError(f"source '{text[:80]}': give tcp:HOST:PORT, such as tcp:192.168.4.1:5000.")
    return Server(host, int(port))
