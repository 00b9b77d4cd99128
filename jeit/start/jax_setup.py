"""Functions that configure JAX: precision, compiler, cache of compiled code, and forked processes."""

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
    """Set JAX to double precision, because a light touch changes voltages by 1e-4, for which single precision is not
    accurate enough. A value of JAX_ENABLE_X64 that the user has set takes precedence; if it selects single precision, a
    warning states the loss of accuracy (docs/explanation/numerics.md).

    Products of single-precision matrices use all 24 bits of the factors, which JAX would by default round to 11 bits on
    graphics processors. A value of JAX_DEFAULT_MATMUL_PRECISION that the user has set takes precedence.
    """
    if jax.config.jax_default_matmul_precision is None:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_default_matmul_precision", "highest")
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
    """Value of the environment variable XLA_FLAGS for fast compilation. It must be set before JAX computes anything.

    Without optimisation, compilation takes a quarter of the time. The flags depend on the version of jaxlib, because
    XLA (JAX's compiler) aborts the process at unknown flags.
    """
    fusion_option = " --xla_cpu_use_fusion_emitters=false" if version("jaxlib").startswith("0.10.") else ""
    return f"--xla_backend_optimization_level=0{fusion_option}"


_refuses_compilation = False


def refuse_compiled_code_in_forks() -> None:
    """Make compiled code raise `RuntimeError` in processes forked after JAX has started. A forked process lacks JAX's
    threads, so a compiled program would wait forever. Methods of jeit that run in NumPy still work, and a process
    forked before JAX has started is not restricted."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_refuse_compilation_in_child)


def _refuse_compilation_in_child() -> None:
    global _refuses_compilation
    if _refuses_compilation or not _jax_has_started():
        return
    _refuses_compilation = True
    jax.clear_caches()  # programs compiled before the fork must not run; they would be compiled anew, which is refused
    jax.monitoring.register_event_duration_secs_listener(_raise_at_compilation)


def _jax_has_started() -> bool:
    from jax._src import xla_bridge

    return xla_bridge.backends_are_initialized()


def _raise_at_compilation(event: str, duration_secs: float, **_: str | int) -> None:
    """Listener to JAX's monitoring events: raises `RuntimeError` after tracing, before a program is compiled."""
    del duration_secs
    if event.startswith("/jax/core/compile"):
        raise RuntimeError(
            "This process was forked from one that had started JAX, whose threads are not in it: compiled code would "
            'wait for ever. Start processes by multiprocessing.get_context("spawn"), or fork before anything is '
            "computed; methods of a model that are called as they are, outside jax.jit and derivatives, work here."
        )


# Maximum total size and number of the files in the cache of compiled programs.
_MAX_CACHE_BYTES, _MAX_CACHE_FILES = 256 * 2**20, 5000


def keep_compiled_code() -> None:
    """Store compiled programs in the user's cache folder, so that a program is compiled once per machine instead of
    once per process.

    Nothing is changed if the user has set a cache folder for JAX (`JAX_COMPILATION_CACHE_DIR`, or
    `jax_compilation_cache_dir`), if `JEIT_COMPILATION_CACHE` is "off", or if the folder cannot be written to. JAX
    identifies programs by their text and by the versions of JAX and of the compiler. The least recently used programs
    are deleted when there are more than 5,000 files or 256 MiB.
    """
    user_cache_folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    cache_setting = os.environ.get("JEIT_COMPILATION_CACHE", "").strip().lower()
    if user_cache_folder is not None or cache_setting in ("off", "0", "no", "none", "false", "disabled"):
        return
    try:
        cache_folder = _cache_folder() / "jeit" / "jax"
        processor_folder = cache_folder / _processor_identifier()
        processor_folder.mkdir(parents=True, exist_ok=True)
        _discard_oldest_programs(cache_folder)
    except (OSError, RuntimeError):
        return
    if os.access(processor_folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(processor_folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def discard_damaged_cache_files(warning: str) -> bool:
    """Whether a warning is JAX's message that a cached program could not be read; if so, delete all cached files with
    the program's name.

    JAX does not overwrite cached files. If they stayed, it would compile the program again and repeat the warning in
    every later process.
    """
    warning_match = re.match(r"Error reading persistent compilation cache entry for '([\w<>.-]+)'", warning)
    processor_folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if (
        warning_match is None
        or not processor_folder
        or not Path(processor_folder).is_relative_to(_cache_folder() / "jeit")
    ):
        return False
    for cache_file in Path(processor_folder).glob(f"{glob.escape(warning_match[1])}-*"):
        with contextlib.suppress(OSError):
            cache_file.unlink()
    return True


def _processor_identifier() -> str:
    """Identifier of the type of processor, by which compiled programs are stored. Machines with different processors
    may share a home folder, and must not run each other's programs."""
    processor_description = platform.machine() + platform.processor()
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as cpu_info:
        processor_description += next((line for line in cpu_info if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(processor_description.encode()).hexdigest()[:12]


def _discard_oldest_programs(cache_folder: Path) -> None:
    """Delete the least recently used cached programs until the limits on number and size are met. Also delete empty
    files, which remain when the disk was full, and which JAX cannot read."""
    cache_files = sorted(_last_uses_of_files(cache_folder), reverse=True)
    total_bytes = 0
    for file_index, (_, file_bytes, cache_file) in enumerate(cache_files):
        total_bytes += file_bytes
        if file_index >= _MAX_CACHE_FILES or total_bytes > _MAX_CACHE_BYTES or not file_bytes:
            cache_file.unlink(missing_ok=True)


def _last_uses_of_files(cache_folder: Path) -> Iterator[tuple[float, int, Path]]:
    """Time of last use, size in bytes, and path of each file in the cache folder."""
    for cache_file in cache_folder.glob("*/*"):
        with contextlib.suppress(FileNotFoundError):  # another process may delete the file
            file_status = cache_file.stat()
            yield max(file_status.st_atime, file_status.st_mtime), file_status.st_size, cache_file


def _cache_folder() -> Path:
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    folder_variable = "LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"
    user_folder = Path(os.environ.get(folder_variable, ""))
    return user_folder if user_folder.is_absolute() else Path.home() / ".cache"
