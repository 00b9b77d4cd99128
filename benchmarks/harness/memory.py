"""Peak memory of this process, where the system reports it."""

from __future__ import annotations

import gc
from pathlib import Path


def peak_memory() -> float | None:
    """Peak resident memory of this process in MB since `reset_peak_memory`; None on systems other than Linux."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM")), None)


def reset_peak_memory() -> None:
    """Restart the measurement of peak memory, where the system allows it."""
    gc.collect()
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def available_memory() -> float:
    """Free memory in bytes (8 GiB if the system does not report it)."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return 8.0 * 2**30
    return next(float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
