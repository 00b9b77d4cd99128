"""Atomic writing of files: a new file is written beside the old one, and replaces it once it is completely on the
disk."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


def boot() -> str:
    """Identifier of the current boot of the system, which containers share; "" if unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def is_alive(pid: object) -> bool:
    """Whether a process of this machine is running; True if unknown."""
    if os.name != "posix" or not isinstance(pid, int) or isinstance(pid, bool) or pid <= 0:
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


_UNFINISHED = re.compile(r"\.jeit-([0-9a-f]{8})-(\d+)-[0-9a-f]{8}\.part")


@contextmanager
def written_whole(path: str | Path) -> Iterator[BinaryIO]:
    """Context that yields a file to write to, which replaces `path` once it is completely on the disk. If the process
    is killed before that, the old file remains.

    A link at `path` is replaced, not followed. Raises `OSError` if the file cannot be written.
    """
    path = Path(path)
    clear_unfinished(path.parent)
    other = path.parent / _unfinished()
    try:
        with other.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        other.replace(path)
    finally:
        other.unlink(missing_ok=True)


@contextmanager
def whole_files(folder: Path) -> Iterator[Path]:
    """Context that yields a folder to write several files to, which are moved to `folder` once all of them are written.

    Links in `folder` with the same names are replaced, not followed. Raises `OSError` if the files cannot be written.
    """
    clear_unfinished(folder)
    beside = folder / _unfinished()
    beside.mkdir()
    try:
        yield beside
        for one in sorted(beside.iterdir()):
            with one.open("rb") as file:
                os.fsync(file.fileno())
        for one in sorted(beside.iterdir()):
            one.replace(folder / one.name)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def clear_unfinished(folder: Path) -> None:
    """Remove unfinished files that killed processes of this machine have left in a folder."""
    with suppress(OSError):
        for one in folder.iterdir():
            made = _UNFINISHED.fullmatch(one.name)
            if made and made[1] == _machine() and not is_alive(int(made[2])):
                shutil.rmtree(one, ignore_errors=True) if one.is_dir() and not one.is_symlink() else one.unlink()


def _unfinished() -> str:
    return f".jeit-{_machine()}-{os.getpid()}-{secrets.token_hex(4)}.part"


def _machine() -> str:
    """Hash of the current boot of this machine, eight characters; processes of other machines cannot be checked."""
    return f"{zlib.crc32(boot().encode()):08x}"
