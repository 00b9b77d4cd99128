"""Lock for one writing process per store: a file beside the store names the process, and is ignored if it has ended."""

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
    """Context in which this process alone writes the store at `path`, of a `kind` in one word.

    The lock is the file `.NAME.lock` beside the store, held by `flock`, which the system releases when the process ends
    for any reason. Its content names the owner; where that is on another machine, whose processes cannot be checked,
    the content alone holds the lock. Raises `ValueError` where another process, or another thread of this one, writes
    the store, and `OSError` where no file can be written beside it.
    """
    path = path.resolve()  # one lock, by whatever link it is reached
    place = path.with_name(f".{path.name}.lock")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        handle = _own(place, path, kind)
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


def _own(place: Path, path: Path, kind: str) -> int:
    """The lock's file, opened and held."""
    while True:
        handle = os.open(place, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            held = _hold(handle)
            if held and not _is_at(handle, place):  # its owner has just ended and removed it
                os.close(handle)
                continue
            owner = _owner(handle)
            if held is False or (owner and not _gone(owner, certain=held is True)):
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
    """Whether this process now holds the file; None where the system or the file system does not support locks."""
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
    """Owner named in the file; empty if the owner ended before it was written."""
    try:
        owner = json.loads(os.pread(handle, _LONGEST, 0))
    except (ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _gone(owner: dict, *, certain: bool) -> bool:
    """Whether the owner has ended; `certain` where it no longer holds the file, which is conclusive on this machine
    only."""
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
