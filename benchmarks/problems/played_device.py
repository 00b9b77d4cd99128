"""A serial device with a series of faults, simulated on a pseudo-terminal in a separate process.

The arguments are those of `play`. A symbolic link names the pseudo-terminal, like the links of udev: when the device is
unplugged, the link disappears; when the device is plugged in again, the link names another pseudo-terminal.
"""

from __future__ import annotations

import fcntl
import os
import random
import struct
import sys
import termios
import time
import tty
from pathlib import Path

ENTRY = struct.Struct("<id")
"""Record of each frame sent completely: the number of its line, and `time.monotonic()` after that."""
FAULTS = ("garbage", "half a line", "another number of channels", "no readings", "twice the rate", "unplugged")
# Seconds for which the frame rate is doubled, for which the device is unplugged, of rest before it is unplugged, and of
# waiting for the reader.
_DOUBLED, _UNPLUGGED, _REST, _PATIENCE = 2.0, 1.0, 0.1, 5.0


class _Terminal:
    def __init__(self, link: Path):
        self.link, self.leader = link, -1

    def plug(self) -> None:
        """Create a pseudo-terminal, and let the link name it. Writing to the terminal fails, instead of blocking, if
        nobody reads."""
        self.leader, self.follower = os.openpty()
        tty.setraw(self.follower)
        os.set_blocking(self.leader, False)
        beside = self.link.with_name("next")
        beside.symlink_to(os.ttyname(self.follower))
        beside.replace(self.link)

    def unplug(self) -> None:
        """Remove the pseudo-terminal once all bytes have been read, so that no sent data are lost."""
        end = time.monotonic() + _PATIENCE
        while self._unread() and time.monotonic() < end:
            time.sleep(1e-3)
        self.link.unlink()
        os.close(self.follower)
        os.close(self.leader)

    def _unread(self) -> int:
        """Number of bytes that wait for the reader."""
        return struct.unpack("i", fcntl.ioctl(self.follower, termios.FIONREAD, b"\0" * 4))[0]

    def send(self, content: bytes) -> None:
        """Write all bytes of `content`, as fast as they are read."""
        while content:
            try:
                content = content[os.write(self.leader, content) :]
            except BlockingIOError:
                time.sleep(1e-3)


def play(lines: Path, link: Path, log: Path, seconds: float, rate: float, period: float) -> None:
    """Send the lines of the file `lines`, one frame each, repeatedly for a number of `seconds`, at `rate` frames/s,
    with a fault every `period` seconds.

    Record each frame that is sent completely in the file `log`, and print each simulated fault.
    """
    frames = lines.read_bytes().splitlines(keepends=True)
    terminal, noise = _Terminal(link), random.Random(0)
    terminal.plug()
    sys.stdin.readline()  # until the reader is there
    begin = due = time.monotonic()
    number, fault, doubled = 0, 0, 0.0
    with log.open("wb", buffering=0) as noted:
        while (now := time.monotonic()) < begin + seconds:
            if now > begin + (fault + 0.5) * period:
                kind = FAULTS[fault % len(FAULTS)]
                fault += 1
                print(kind, flush=True)
                line = frames[number % len(frames)]
                if kind == "garbage":
                    terminal.send(noise.randbytes(300).replace(b"\n", b"").replace(b"\r", b"") + b"\n")
                elif kind == "half a line":
                    terminal.send(line[: len(line) // 2] + b"\n")
                elif kind == "another number of channels":
                    terminal.send(line.rpartition(b",")[0] + b"\n")
                elif kind == "no readings":
                    terminal.send(b"nan, " * line.count(b",") + b"nan\n")
                elif kind == "twice the rate":
                    doubled = now + _DOUBLED
                else:
                    time.sleep(_REST)
                    terminal.unplug()
                    time.sleep(_UNPLUGGED)
                    terminal.plug()
                    # A device that is plugged in begins to send when the reader has opened it.
                    time.sleep(_UNPLUGGED)
                    due = time.monotonic()
            terminal.send(frames[number % len(frames)])
            noted.write(ENTRY.pack(number % len(frames), time.monotonic()))
            number += 1
            due += 1 / (2 * rate if time.monotonic() < doubled else rate)
            time.sleep(max(0.0, due - time.monotonic()))
    time.sleep(_REST)
    terminal.unplug()


if __name__ == "__main__":
    given = sys.argv[1:]
    play(Path(given[0]), Path(given[1]), Path(given[2]), *map(float, given[3:]))
