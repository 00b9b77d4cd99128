"""Archives of scikit-learn's estimators in skops' format: the same bytes for the same content, and a checksum.

skops numbers objects by their address in memory, and dates its members; here they are numbered in their order, without
dates. The seal, a checksum, distinguishes a file that was changed from one that jeit wrote; it is no secret.
"""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

_SCHEMA = "schema.json"
# The number of an object, or the file that is named after it.
_NUMBER = re.compile(r'("__id__": |"file": ")(\d+)')


def write_sealed(content: Any, file: BinaryIO) -> None:
    """Write arrays, estimators, and lists and dictionaries of them."""
    from skops.io import dumps

    with zipfile.ZipFile(io.BytesIO(dumps(content))) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    numbers: dict[str, str] = {}

    def numbered(found: re.Match[str]) -> str:
        return found[1] + numbers.setdefault(found[2], str(len(numbers)))

    schema = _NUMBER.sub(numbered, members.pop(_SCHEMA).decode())
    named = {f"{numbers[Path(name).stem]}.npy": values for name, values in members.items()}
    named = {_SCHEMA: schema.encode(), **dict(sorted(named.items()))}
    with zipfile.ZipFile(file, "w") as archive:
        for name, values in named.items():
            archive.writestr(zipfile.ZipInfo(name), values)
        archive.comment = _seal(named)


def check_seal(path: Path) -> None:
    """Raise `ValueError` for an archive that is not as it was written."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
        if archive.comment != _seal(members):
            raise ValueError("it was changed since it was written, or an earlier jeit wrote it")


def _seal(members: dict[str, bytes]) -> bytes:
    digest = hashlib.sha256()
    for name in sorted(members):
        digest.update(f"{name} {len(members[name])}\n".encode() + members[name])
    return b"jeit " + digest.hexdigest().encode()
