"""Cache of compiled programs between runs: its folder, its keys and its size."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import platform
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import jax

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
