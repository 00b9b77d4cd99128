"""What the figures were measured on."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("jeit", "jax", "jaxlib", "numpy", "scipy", "equinox", "lineax")


def use_cores(count: int) -> None:
    """Bind this process, and those it starts, to `count` cores, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, allowed[:count])


def heading() -> list[str]:
    """Lines that name the machine, its cores, the operating system and the versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    packages = ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    return [
        f"{_processor()}; {cores} of {os.cpu_count()} cores, {_memory()}; {platform.system()} {platform.release()}; "
        f"load {os.getloadavg()[0]:.1f} at the start"
        if hasattr(os, "getloadavg")
        else _processor(),
        f"Python {platform.python_version()}, {packages}; commit {_commit()}; double precision.",
    ]


def available_memory() -> float:
    """Memory in bytes that is free to use now (8 GiB if the system does not say)."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return 8.0 * 2**30
    return next(float(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        return platform.processor() or platform.machine()
    return platform.machine()


def _memory() -> str:
    if not hasattr(os, "sysconf"):
        return "memory unknown"
    return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _commit() -> str:
    folder = Path(__file__).parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return f"unknown ({sys.platform})"
