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

_MAX_BYTES = 4096


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
        descriptor = _acquire(lock_path, path, content_name)
    except OSError as error:
        action_verb = "written" if path.exists() else "made"
        reason = f"the {content_name}'s store cannot be {action_verb} ({error.strerror})"
        raise OSError(error.errno, reason, str(path)) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            lock_path.unlink()
        os.close(descriptor)


def _acquire(lock_path: Path, store_path: Path, content_name: str) -> int:
    """Open the lock file and acquire the lock. Returns the file descriptor."""
    while True:
        descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            is_locked = _try_to_lock(descriptor)
            if is_locked and not _is_current_lock_file(
                descriptor, lock_path
            ):  # the previous owner has just ended and removed the lock file
                os.close(descriptor)
                continue
            owner = _read_owner(descriptor)
            if is_locked is False or (owner and not _has_ended(owner, is_lock_released=is_locked is True)):
                raise ValueError(_refusal_message(owner, lock_path, store_path, content_name))
            try:
                _write_owner(descriptor)
            except OSError:  # a full disk
                lock_path.unlink()
                raise
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(descriptor)
            raise
        return descriptor


def _try_to_lock(descriptor: int) -> bool | None:
    """Try to lock the lock file. Returns whether this process holds the lock now; None if the system or the file system
    does not support locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is_current_lock_file(descriptor: int, lock_path: Path) -> bool:
    """Whether the open file `descriptor` is still the file at the path of the lock."""
    try:
        return os.path.samestat(os.fstat(descriptor), lock_path.stat())
    except FileNotFoundError:
        return False


def _write_owner(descriptor: int) -> None:
    """Write this process, its machine and the time into the lock file as JSON, so that other processes can name the
    owner."""
    owner = {"pid": os.getpid(), "host": platform.node(), "boot": boot_identifier()}
    owner["since"] = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, json.dumps(owner).encode(), 0)
    os.fsync(descriptor)


def _read_owner(descriptor: int) -> dict:
    """Read from the lock file which process owns the lock; empty if the owner ended before the file was written."""
    try:
        owner = json.loads(os.pread(descriptor, _MAX_BYTES, 0))
    except (ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _has_ended(owner: dict, *, is_lock_released: bool) -> bool:
    """Whether the process that owns the lock file has ended. `is_lock_released`: whether the owner is known not to hold
    the file's lock any more, which is conclusive only for an owner on this machine."""
    return _is_on_this_machine(owner) and (is_lock_released or not is_alive(owner.get("pid")))


def _is_on_this_machine(owner: dict) -> bool:
    """Whether the process that owns the lock runs, or ran, on this machine, by the machine's name or boot
    identifier."""
    return owner.get("host") == platform.node() or (bool(boot_identifier()) and owner.get("boot") == boot_identifier())


def _refusal_message(owner: dict, lock_path: Path, store_path: Path, content_name: str) -> str:
    owner_text = f"process {describe(owner['pid'])}" if "pid" in owner else "another process"
    since_text = f" since {describe(owner['since']).strip(chr(39))}" if "since" in owner else ""
    if not owner or (_is_on_this_machine(owner) and fcntl is not None):
        owner_text = "this process" if owner.get("pid") == os.getpid() else owner_text
        remedy = f"wait until it ends, or stop it, then resume the {content_name}."
        return f"{store_path} is being written by {owner_text}{since_text}; {remedy}"
    machine_text = "this machine" if _is_on_this_machine(owner) else describe(owner.get("host"))
    return (
        f"{store_path} is being written by {owner_text} on {machine_text}{since_text}, or was when that was killed: "
        f"from here this cannot be seen. Where it still runs, wait; where it does not, delete {lock_path} and resume "
        f"the {content_name}."
    )
