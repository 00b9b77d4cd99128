"""Check of a store's metadata as plain JSON, before Zarr opens any of it.

Zarr looks up a codec by the name in a file, and one of them, pickle, runs whatever the file holds. So a store from
somebody else is opened only where it is what jeit writes: format 3, the arrays of its contents and no other, of numbers
and text, through codecs that only pack bytes, and no links to other places.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

# Those that pack bytes and nothing else. One that holds further codecs (sharding) is not among them.
CODECS = frozenset({"blosc", "bytes", "crc32c", "transpose", "vlen-utf8", "zstd"})
# Bytes of a chunk of texts at most, and of what a chunk of numbers may have beside them.
_LARGEST, _BESIDE = 2**24, 2**12

_NUMBERS = tuple(f"{kind}{bits}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64))
_TYPES = frozenset({"bool", "string", *_NUMBERS})
_FORMAT_2 = (".zarray", ".zattrs", ".zgroup", ".zmetadata")
_METADATA = "zarr.json"
_UNREADABLE = f"has a {_METADATA} that is no JSON object, or nested too deep"


class ArrayShape(NamedTuple):
    """Of one array of a store: how many values along each axis, how many in a chunk, and Zarr's name of its type."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    data_type: str


def danger(path: Path) -> str | None:
    """The reason why the store must not be opened; None where nothing in it can run code or link to other paths. Raises
    `OSError` for files that cannot be read."""
    for folder, folders, files in os.walk(path):
        for name in [*folders, *files]:
            place = Path(folder, name)
            if place.is_symlink():
                return f"'{place.relative_to(path)}' is a link to another place"
            if name in _FORMAT_2:
                return f"'{place.relative_to(path)}' is of Zarr's format 2, which jeit does not write"
    for file in path.rglob(_METADATA):
        content = _read(file)  # what Zarr cannot read is damage, not danger
        for where, node in [] if content is None else _nodes(content, str(file.relative_to(path))):
            reason = _node_danger(node)
            if reason:
                return f"{where} {reason}"
    return None


def damage(path: Path, expected: Mapping[str, ArrayShape]) -> str | None:
    """The difference from a store of the arrays `expected`, by name; None if there is none. Raises `OSError` for files
    that cannot be read."""
    content = _read(path / _METADATA)
    if content is None:
        return _UNREADABLE
    found = {folder.name for folder in path.iterdir() if folder.is_dir()}
    if found != set(expected):
        return f"its arrays are not those of its contents: {_shortened(found ^ set(expected))}"
    if content.get("zarr_format") != 3 or content.get("node_type") != "group":
        return "it is no group of Zarr's format 3"
    consolidated = content.get("consolidated_metadata")
    named = consolidated.get("metadata") if isinstance(consolidated, dict) else None
    if not isinstance(named, dict) or set(named) != set(expected):
        return "it does not name the arrays of its contents"
    for name, array in expected.items():
        if [*(path / name).rglob(_METADATA)] != [path / name / _METADATA]:
            return f"array '{name}' has not one {_METADATA}"
        own = _read(path / name / _METADATA)
        reason = _UNREADABLE if own is None else _node_damage(named[name], array) or _node_damage(own, array)
        reason = reason or _chunk_damage(path / name, array)
        if reason:
            return f"array '{name}' {reason}"
    return None


def _chunk_damage(folder: Path, array: ArrayShape) -> str | None:
    """Whether a chunk declares a larger unpacked size than its array's chunks have."""
    most = _LARGEST if array.data_type == "string" else 8 * math.prod(array.chunks) + _BESIDE
    for file in folder.rglob("*"):
        if file.is_file() and file.name != _METADATA:
            with file.open("rb") as opened:
                size = _unpacked(opened.read(18), file.stat().st_size)
            if size is None or size > most:
                return f"has a chunk, '{file.relative_to(folder)}', of {size or 'unknown'} bytes, more than {most}"
    return None


def _unpacked(beginning: bytes, size: int) -> int | None:
    """Bytes of a chunk that begins so and has this `size`, unpacked: as a frame of zstd says (RFC 8878), or a header of
    blosc; of none of these its size itself. None where a frame does not say it."""
    if beginning.startswith(b"\x28\xb5\x2f\xfd") and len(beginning) > 5:
        about = beginning[4]
        single = about >> 5 & 1
        start = 5 + (1 - single) + (0, 1, 2, 4)[about & 3]
        length = (single, 2, 4, 8)[about >> 6]
        number = int.from_bytes(beginning[start : start + length], "little")
        return number + (256 if length == 2 else 0) if length else None
    if beginning[:1] == b"\x02" and len(beginning) >= 16:
        return max(size, int.from_bytes(beginning[4:8], "little"))
    return size


def _nodes(content: Any, where: str) -> Iterator[tuple[str, Any]]:
    """Every group and array that metadata describe, those of consolidated metadata, however deep, included."""
    yield f"'{where}'", content
    consolidated = content.get("consolidated_metadata") if isinstance(content, dict) else None
    inner = consolidated.get("metadata") if isinstance(consolidated, dict) else None
    for name, node in (inner if isinstance(inner, dict) else {}).items():
        yield from _nodes(node, f"{where}: {name}")


def _node_danger(node: Any) -> str | None:
    if not isinstance(node, dict):
        return "describes neither a group nor an array"
    if any(name in node for name in ("dtype", "filters", "compressor")) or node.get("zarr_format") == 2:
        return "is of Zarr's format 2, which jeit does not write"
    if node.get("storage_transformers"):
        return "asks for storage transformers"
    data_type = node.get("data_type")
    if "data_type" in node and not (isinstance(data_type, str) and data_type in _TYPES):
        return f"holds neither numbers nor text but {_shortened([data_type])}"
    codecs = node.get("codecs", [])
    names = [codec.get("name") if isinstance(codec, dict) else codec for codec in _listed(codecs)]
    strange = [name for name in names if not (isinstance(name, str) and name in CODECS)]
    return f"asks for {_shortened(strange)}, and not only for codecs that pack bytes" if strange else None


def _node_damage(node: Any, expected: ArrayShape) -> str | None:
    grid = node.get("chunk_grid")
    configuration = grid.get("configuration") if isinstance(grid, dict) and grid.get("name") == "regular" else None
    chunks = configuration.get("chunk_shape") if isinstance(configuration, dict) else None
    if node.get("zarr_format") != 3 or node.get("node_type") != "array":
        return "is no array of Zarr's format 3"
    if node.get("shape") != [*expected.shape] or chunks != [*expected.chunks]:
        return f"is {node.get('shape')} in chunks of {chunks}, not {[*expected.shape]} in {[*expected.chunks]}"
    if node.get("data_type") != expected.data_type:
        return f"is of {node.get('data_type')}, not {expected.data_type}"
    return None


def _read(file: Path) -> dict[str, Any] | None:
    """The JSON object in a file; None for anything else. Raises `OSError`."""
    try:
        content = json.loads(file.read_bytes())
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def _listed(values: Any) -> list[Any]:
    return values if isinstance(values, list) else [values]


def _shortened(values: Any) -> str:
    """Names from a file that nobody can trust: short, and on one line."""
    return ", ".join(ascii(value)[:60] for value in [*values][:3])
