"""The conditions under which figures were measured: the machine, the versions, the commit, the day."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CORES = 2
PACKAGES = ("jeit", "jax", "jaxlib", "numpy", "scipy", "equinox", "lineax")
# Files that affect figures. RESULTS.md, README.md and pages of docs/ are written by the command of the benchmarks.
MEASURED = ("jeit", "solvers", "benchmarks", "pyproject.toml", ":!benchmarks/RESULTS.md")


def use_cores(count: int = CORES) -> None:
    """Bind this process, and its child processes, to `count` cores, where the system allows it."""
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, allowed[:count])


def same_for_all(threads: int = CORES, *, compiled: bool = False) -> dict[str, str]:
    """The environment variables of every measured process: the same number of threads of linear algebra, and no cache
    of compiled code, unless `compiled`."""
    environment = dict(os.environ)
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        environment[variable] = str(threads)
    if not compiled:
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    return environment


def heading() -> list[str]:
    """Lines that name the machine, its cores, the operating system, the versions, the commit and the day."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f"; load {os.getloadavg()[0]:.1f} at the start" if hasattr(os, "getloadavg") else ""
    packages = ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    system = f"{platform.system()} {platform.release()}"
    flags = os.environ.get("XLA_FLAGS")
    return [
        f"{_processor()}; {cores} of {os.cpu_count()} cores, {_memory()}; {system}{load}",
        f"Python {platform.python_version()}, {packages}; double precision" + (f"; XLA_FLAGS {flags}" if flags else ""),
        f"commit {commit()}, {time.strftime('%Y-%m-%d', time.gmtime())}",
    ]


def commit() -> str:
    """The measured commit, with `-dirty` if any file that affects figures differs from it."""
    try:
        name = _git("rev-parse", "--short", "HEAD")
        changed = _git("status", "--porcelain", "--", *MEASURED)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{name}-dirty" if changed else name


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


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
