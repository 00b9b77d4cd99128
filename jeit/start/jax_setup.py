"""Set-up of JAX."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import platform
import re
import sys
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import jax


def take_double_precision() -> None:
    """Set JAX to double precision: a light touch changes voltages by 1e-4, for which single precision is not enough.
    JAX_ENABLE_X64 set by the user takes precedence, with a warning of the cost of single precision
    (docs/numerics.md)."""
    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
    elif not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        warnings.warn(
            f"JAX_ENABLE_X64={os.environ['JAX_ENABLE_X64'][:20]}: jeit computes in single precision, where voltages "
            "are wrong by 1e-5 of the largest (1e-14 in double precision), a tenth of what a light touch changes, and "
            "contacts and conductivities must not differ by more than some thousand times; unset it for double "
            "precision.",
            UserWarning,
            stacklevel=3,
        )


def quick_compilation() -> str:
    """A value for the environment variable XLA_FLAGS, to be set before JAX computes anything.

    Code without optimisation takes a quarter of the time to compile. XLA ends the process at flags that it does not
    know, and they come and go.
    """
    fusion = " --xla_cpu_use_fusion_emitters=false" if version("jaxlib").startswith("0.10.") else ""
    return f"--xla_backend_optimization_level=0{fusion}"


_refusing = False


def refuse_compiled_code_in_forks() -> None:
    """Make compiled code raise `RuntimeError` in processes that `os.fork` makes once JAX has started: its threads are
    not in them, so that a program would wait for ever. Methods that run in NumPy still work; and where a process forks
    before JAX has started, everything works."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_forked)


def _forked() -> None:
    global _refusing
    if _refusing or not _has_started():
        return
    _refusing = True
    jax.clear_caches()  # nothing compiled before the fork is found again, and what is traced anew is refused
    jax.monitoring.register_event_duration_secs_listener(_refuse)


def _has_started() -> bool:
    from jax._src import xla_bridge

    return xla_bridge.backends_are_initialized()


def _refuse(event: str, duration_secs: float, **_: str | int) -> None:
    """A listener to JAX's monitoring events: raises before a program is compiled, after tracing."""
    del duration_secs
    if event.startswith("/jax/core/compile"):
        raise RuntimeError(
            "This process was forked from one that had started JAX, whose threads are not in it: compiled code would "
            'wait for ever. Start processes by multiprocessing.get_context("spawn"), or fork before anything is '
            "computed; methods of a model that are called as they are, outside jax.jit and derivatives, work here."
        )


_MOST_BYTES, _MOST_FILES = 256 * 2**20, 5000


def keep_compiled_code() -> None:
    """Keep compiled programs in the user's cache folder, so that a program is compiled once on a machine, not in every
    process.

    Does nothing if the user has set where JAX keeps them (`JAX_COMPILATION_CACHE_DIR`, or `jax_compilation_cache_dir`),
    if `JEIT_COMPILATION_CACHE` is "off", or where no folder can be written to. JAX looks programs up by their text and
    by its own and the compiler's versions. Those used longest ago go when there are thousands, or a quarter of a
    gigabyte.
    """
    given = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    asked = os.environ.get("JEIT_COMPILATION_CACHE", "").strip().lower()
    if given is not None or asked in ("off", "0", "no", "none", "false", "disabled"):
        return
    try:
        every = _cache_folder() / "jeit" / "jax"
        folder = every / _processor()
        folder.mkdir(parents=True, exist_ok=True)
        _discard_oldest(every)
    except (OSError, RuntimeError):
        return
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def discarded_damaged(warning: str) -> bool:
    """Whether a warning is JAX's that it could not read a program it kept; all kept under its name are gone then.

    It would compile it anew in every process to come, and say so again: it does not write over what is there.
    """
    given = re.match(r"Error reading persistent compilation cache entry for '([\w<>.-]+)'", warning)
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if given is None or not folder or not Path(folder).is_relative_to(_cache_folder() / "jeit"):
        return False
    for path in Path(folder).glob(f"{glob.escape(given[1])}-*"):
        with contextlib.suppress(OSError):
            path.unlink()
    return True


def _processor() -> str:
    """A name for this kind of processor: where homes are shared, its code must not run on another."""
    described = platform.machine() + platform.processor()
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as lines:
        described += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(described.encode()).hexdigest()[:12]


def _discard_oldest(folder: Path) -> None:
    """Remove the oldest files where there are too many, and empty ones, as are left by a full disk, which JAX would
    fail to read."""
    kept = sorted(_used(folder), reverse=True)
    size = 0
    for number, (_, bytes_taken, path) in enumerate(kept):
        size += bytes_taken
        if number >= _MOST_FILES or size > _MOST_BYTES or not bytes_taken:
            path.unlink(missing_ok=True)


def _used(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """When each file was last used, its bytes, and its path."""
    for path in folder.glob("*/*"):
        with contextlib.suppress(FileNotFoundError):  # another process discards too
            given = path.stat()
            yield max(given.st_atime, given.st_mtime), given.st_size, path


def _cache_folder() -> Path:
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    variable = "LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"
    given = Path(os.environ.get(variable, ""))
    return given if given.is_absolute() else Path.home() / ".cache"
