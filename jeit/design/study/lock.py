"""Lock that allows one process at a time to write a store of results: a file beside the store names the process, and is
ignored once this process has ended."""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from jeit.arguments import describe
from jeit.files.atomic_write import boot_identifier, is_alive

try:
    import fcntl
except ImportError:
    fcntl = None  # not POSIX

_MAX_LOCK_FILE_BYTES = 4096


@contextlib.contextmanager
def lock_store(path: Path, content_name: str) -> Iterator[None]:
    """Context in which no other process writes the store of results at `path`. `content_name`: one word for the
    contents of the store, for messages.

    The lock is a `flock` on the file `.NAME.lock` beside the store. The system releases the lock when the process ends
    for any reason. The content of the file names the owner, the process that writes the store. If the owner is on
    another machine, whose processes cannot be checked, the store counts as locked as long as the file exists. Raises
    `ValueError` if another process, or another thread of this process, writes the store, and `OSError` if no file can
    be written beside the store.
    """
    path = path.resolve()  # the same lock, whichever link leads to the store
    lock_path = path.with_name(f".{path.name}.lock")
    try:
        lock_path.parent.mkdir(parents=True, exist_ok=True)
        lock_descriptor = _acquire_lock(lock_path, path, content_name)
    except OSError as error:
        action_verb = "written" if path.exists() else "made"
        error_reason = f"the {content_name}'s store cannot be {action_verb} ({error.strerror})"
        raise OSError(error.errno, error_reason, str(path)) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            lock_path.unlink()
        os.close(lock_descriptor)


def _acquire_lock(lock_path: Path, store_path: Path, content_name: str) -> int:
    """Open the lock file and acquire the lock. Returns the file descriptor."""
    while True:
        lock_descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            is_locked = _try_to_lock(lock_descriptor)
            if is_locked and not _is_current_lock_file(
                lock_descriptor, lock_path
            ):  # the previous owner has just ended and removed the lock file
                os.close(lock_descriptor)
                continue
            lock_owner = _read_owner(lock_descriptor)
            if is_locked is False or (lock_owner and not _has_ended(lock_owner, is_lock_released=is_locked is True)):
                raise ValueError(_refusal_message(lock_owner, lock_path, store_path, content_name))
            try:
                _write_owner(lock_descriptor)
            except OSError:  # a full disk
                lock_path.unlink()
                raise
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(lock_descriptor)
            raise
        return lock_descriptor


def _try_to_lock(lock_descriptor: int) -> bool | None:
    """Try to lock the lock file. Returns whether this process holds the lock now; None if the system or the file system
    does not support locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(lock_descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is_current_lock_file(lock_descriptor: int, lock_path: Path) -> bool:
    """Whether the open file `lock_descriptor` is still the file at the path of the lock."""
    try:
        return os.path.samestat(os.fstat(lock_descriptor), lock_path.stat())
    except FileNotFoundError:
        return False


def _write_owner(lock_descriptor: int) -> None:
    """Write this process, its machine and the time into the lock file as JSON, so that other processes can name the
    owner."""
    lock_owner = {"pid": os.getpid(), "host": platform.node(), "boot": boot_identifier()}
    lock_owner["since"] = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    os.ftruncate(lock_descriptor, 0)
    os.pwrite(lock_descriptor, json.dumps(lock_owner).encode(), 0)
    os.fsync(lock_descriptor)


def _read_owner(lock_descriptor: int) -> dict:
    """Read from the lock file which process owns the lock; empty if the owner ended before the file was written."""
    try:
        lock_owner = json.loads(os.pread(lock_descriptor, _MAX_LOCK_FILE_BYTES, 0))
    except (ValueError, RecursionError):
        return {}
    return lock_owner if isinstance(lock_owner, dict) else {}


def _has_ended(lock_owner: dict, *, is_lock_released: bool) -> bool:
    """Whether the process that owns the lock file has ended. `is_lock_released`: whether the owner is known not to hold
    the file's lock any more, which is conclusive only for an owner on this machine."""
    return _is_on_this_machine(lock_owner) and (is_lock_released or not is_alive(lock_owner.get("pid")))


def _is_on_this_machine(lock_owner: dict) -> bool:
    """Whether the process that owns the lock runs, or ran, on this machine, by the machine's name or boot
    identifier."""
    return lock_owner.get("host") == platform.node() or (
        bool(boot_identifier()) and lock_owner.get("boot") == boot_identifier()
    )


def _refusal_message(lock_owner: dict, lock_path: Path, store_path: Path, content_name: str) -> str:
    owner_text = f"process {describe(lock_owner['pid'])}" if "pid" in lock_owner else "another process"
    since_text = f" since {describe(lock_owner['since']).strip(chr(39))}" if "since" in lock_owner else ""
    if not lock_owner or (_is_on_this_machine(lock_owner) and fcntl is not None):
        owner_text = "this process" if lock_owner.get("pid") == os.getpid() else owner_text
        suggested_remedy = f"wait until it ends, or stop it, then resume the {content_name}."
        return f"{store_path} is being written by {owner_text}{since_text}; {suggested_remedy}"
    machine_text = "this machine" if _is_on_this_machine(lock_owner) else describe(lock_owner.get("host"))
    return (
        f"{store_path} is being written by {owner_text} on {machine_text}{since_text}, or was when that was killed: "
        f"from here this cannot be seen. Where it still runs, wait; where it does not, delete {lock_path} and resume "
        f"the {content_name}."
    )
