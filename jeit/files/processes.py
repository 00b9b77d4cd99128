"""Which processes live: of this machine alone it can be told."""

from __future__ import annotations

import os
from pathlib import Path


def boot() -> str:
    """Which run of the system this is: containers with names of their own share it; "" where it is not known."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def is_alive(pid: object) -> bool:
    """Whether a process of this machine lives; True where that is not known."""
    if os.name != "posix" or not isinstance(pid, int) or isinstance(pid, bool) or pid <= 0:
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
