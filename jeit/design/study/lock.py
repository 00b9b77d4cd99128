"""Lock that allows one process at a time to write a store: a file beside the store names the process, and is ignored
once that process has ended."""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from jeit.arguments import describe
from jeit.files.whole import boot, is_alive

try:
    import fcntl
except ImportError:
    fcntl = None  # not POSIX

_LONGEST = 4096


@contextlib.contextmanager
def locked(path: Path, kind: str) -> Iterator[None]:
    """Context in which no other process writes the store at `path`. `kind`: one word for the contents of the store, for
    messages.

    The lock is the file `.NAME.lock` beside the store, held by `flock`, which the system releases when the process ends
    for any reason. Its content names the owner. If the owner is on another machine, whose processes cannot be checked,
    the store counts as locked as long as the file exists. Raises `ValueError` if another process, or another thread of
    this process, writes the store, and `OSError` if no file can be written beside it.
    """
    path = path.resolve()  # the same lock, whichever link leads to the store
    place = path.with_name(f".{path.name}.lock")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        handle = _acquire(place, path, kind)
    except OSError as error:
        done = "written" if path.exists() else "made"
        reason = f"the {kind}'s store cannot be {done} ({error.strerror})"
        raise OSError(error.errno, reason, str(path)) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            place.unlink()
        os.close(handle)


def _acquire(place: Path, path: Path, kind: str) -> int:
    """Open the file of the lock and acquire the lock; returns the file descriptor."""
    while True:
        handle = os.open(place, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            held = _hold(handle)
            if held and not _is_at(handle, place):  # the previous owner has just ended and removed the file
                os.close(handle)
                continue
            owner = _owner(handle)
            if held is False or (owner and not _has_ended(owner, certain=held is True)):
                raise ValueError(_refusal(owner, place, path, kind))
            try:
                _sign(handle)
            except OSError:  # a full disk
                place.unlink()
                raise
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(handle)
            raise
        return handle


def _hold(handle: int) -> bool | None:
    """Try to lock the file. Returns whether this process holds the lock now; None if the system or the file system does
    not support locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is_at(handle: int, place: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), place.stat())
    except FileNotFoundError:
        return False


def _sign(handle: int) -> None:
    owner = {"pid": os.getpid(), "host": platform.node(), "boot": boot()}
    owner["since"] = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    os.ftruncate(handle, 0)
    os.pwrite(handle, json.dumps(owner).encode(), 0)
    os.fsync(handle)


def _owner(handle: int) -> dict:
    """Read the owner from the file; empty if the owner ended before the file was written."""
    try:
        owner = json.loads(os.pread(handle, _LONGEST, 0))
    except (ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _has_ended(owner: dict, *, certain: bool) -> bool:
    """Whether the owner has ended. `certain`: it is known not to hold the lock of the file any more, which is
    conclusive for an owner on this machine only."""
    return _is_here(owner) and (certain or not is_alive(owner.get("pid")))


def _is_here(owner: dict) -> bool:
    return owner.get("host") == platform.node() or (bool(boot()) and owner.get("boot") == boot())


def _refusal(owner: dict, place: Path, path: Path, kind: str) -> str:
    who = f"process {describe(owner['pid'])}" if "pid" in owner else "another process"
    since = f" since {describe(owner['since']).strip(chr(39))}" if "since" in owner else ""
    if not owner or (_is_here(owner) and fcntl is not None):
        who = "this process" if owner.get("pid") == os.getpid() else who
        return f"{path} is being written by {who}{since}; wait until it ends, or stop it, then resume the {kind}."
    where = "this machine" if _is_here(owner) else describe(owner.get("host"))
    return (
        f"{path} is being written by {who} on {where}{since}, or was when that was killed: from here this cannot be "
        f"seen. Where it still runs, wait; where it does not, delete {place} and resume the {kind}."
    )
