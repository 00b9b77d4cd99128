"""Atomic writing of files: a new file is written beside the old file, and replaces the old file once it is completely
on the disk."""

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


def boot_identifier() -> str:
    """Identifier of the current boot of the operating system, which is the same in all containers; "" if unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def is_alive(pid: object) -> bool:
    """Whether the process `pid` of this machine is running; True if unknown."""
    if os.name != "posix" or not isinstance(pid, int) or isinstance(pid, bool) or pid <= 0:
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


_UNFINISHED_NAME_PATTERN = re.compile(r"\.jeit-([0-9a-f]{8})-(\d+)-[0-9a-f]{8}\.part")


@contextmanager
def atomically_written_file(path: str | Path) -> Iterator[BinaryIO]:
    """Context that yields a temporary file to write to; the temporary file replaces `path` once it is completely on the
    disk. If the process is killed earlier, the old file remains.

    A link at `path` is replaced, not followed. Raises `OSError` if the file cannot be written.
    """
    path = Path(path)
    remove_unfinished_files(path.parent)
    temporary_path = path.parent / _unfinished_name()
    try:
        with temporary_path.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary_path.replace(path)
    finally:
        temporary_path.unlink(missing_ok=True)


@contextmanager
def atomically_written_files(folder: Path) -> Iterator[Path]:
    """Context that yields a temporary folder to write several files to; its files are moved to `folder` once all of
    them are written.

    Links in `folder` with the same names are replaced, not followed. Raises `OSError` if the files cannot be written.
    """
    remove_unfinished_files(folder)
    temporary_folder = folder / _unfinished_name()
    temporary_folder.mkdir()
    try:
        yield temporary_folder
        for file_path in sorted(temporary_folder.iterdir()):
            with file_path.open("rb") as file:
                os.fsync(file.fileno())
        for file_path in sorted(temporary_folder.iterdir()):
            file_path.replace(folder / file_path.name)
    finally:
        shutil.rmtree(temporary_folder, ignore_errors=True)


def remove_unfinished_files(folder: Path) -> None:
    """Remove unfinished temporary files that killed processes of this machine have left in a folder."""
    with suppress(OSError):
        for path in folder.iterdir():
            name_match = _UNFINISHED_NAME_PATTERN.fullmatch(path.name)
            if name_match and name_match[1] == _machine_hash() and not is_alive(int(name_match[2])):
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() and not path.is_symlink() else path.unlink()


def _unfinished_name() -> str:
    return f".jeit-{_machine_hash()}-{os.getpid()}-{secrets.token_hex(4)}.part"


def _machine_hash() -> str:
    """Hash of the current boot of this machine, eight characters; used because processes of other machines cannot be
    checked."""
    return f"{zlib.crc32(boot_identifier().encode()):08x}"
