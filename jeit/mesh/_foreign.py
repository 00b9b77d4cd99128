"""Checks of mesh files from any source before meshio opens them: no references to other files, and no content beyond
memory."""

from __future__ import annotations

import lzma
import math
import re
import threading
import types
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from jeit.files import check_memory
from jeit.files.limits import most_bytes

# Formats of one file each, by the endings of names, as meshio calls them. Others may lead to further files (links in
# HDF5), or have readers that wait for ever for a bracket that is not there (Ansys, Nastran, OFF, PLY).
FORMATS = {
    ".inp": "abaqus",
    ".mesh": "medit",
    ".msh": "gmsh",
    ".obj": "obj",
    ".stl": "stl",
    ".su2": "su2",
    ".vtk": "vtk",
    ".vtu": "vtu",
    ".xdmf": "xdmf",
    ".xmf": "xdmf",
}
# Memory that a mesh takes, over its size in the file.
_GROWTH = 4
_INCLUDE = re.compile(rb"^[ \t]*\*[ \t]*include", re.IGNORECASE | re.MULTILINE)
# Sets of an Abaqus file given by their first and last number; the counts in a VTK file, of a grid along each axis.
_GENERATED = re.compile(rb"^[ \t]*\*.*generate", re.IGNORECASE | re.MULTILINE)
_VTK_COUNTS = re.compile(
    rb"^[ \t]*(DIMENSIONS|POINTS|CELLS|CELL_TYPES|\w+_COORDINATES)((?:[ \t]+\d+)+)", re.IGNORECASE | re.MULTILINE
)
# Counts, and whole numbers of so many digits, in a .msh file; and its nodes as bytes.
_COUNTED = re.compile(rb"^\$(Nodes|Elements|PhysicalNames)\s*?\n\s*(\d+)\r?\n", re.MULTILINE)
_LONG = re.compile(rb"(?<![\w.+-])\d{8,}(?![\d.eE])")
_NODE = np.dtype([("number", "<i4"), ("place", "<f8", 3)])
# Numbers of nodes are looked up in an array as long as the largest.
_LARGEST = 10**7
_reading = threading.Lock()


def check_foreign(path: Path) -> str:
    """Name that meshio uses for the format of a file. Raises `ValueError` for a format that is not among `FORMATS`, for
    a file that leads to others or declares entities, and for one too large for memory."""
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise ValueError(
            f"path: {path.name[:80]} does not work as a mesh file: the ending of the name gives the format, "
            f"{', '.join(FORMATS)}. Others that meshio knows are read with trusted=True, where a file comes from you."
        )
    check_memory(path.name[:80], _GROWTH * path.stat().st_size)
    if kind in ("vtu", "xdmf"):
        _check_prologue(path)
    if kind == "xdmf":
        _check_inline(path)
    if kind == "gmsh":
        _check_numbers(path)
    if kind == "abaqus" and _INCLUDE.search(path.read_bytes()):
        raise ValueError(f"path: {path.name[:80]} includes another file; put all into one.")
    if kind == "abaqus" and _GENERATED.search(path.read_bytes()):
        raise ValueError(f"path: {path.name[:80]} has a set by its ends (GENERATE); write its members out.")
    if kind == "vtk":
        _check_counts(path)
    return kind


def _check_numbers(path: Path) -> None:
    """Raise `ValueError` for a .msh file with more nodes or cells, or larger numbers of them, than a file of its size
    has."""
    content = path.read_bytes()
    version, binary = [*content[:64].split(), b"", b"", b""][1:3]
    if content.startswith(b"$MeshFormat") and binary == b"1" and not version.startswith(b"2"):
        raise ValueError(
            f"path: {path.name[:80]} is a binary file of Gmsh's format {version[:8].decode('ascii', 'replace')}; save "
            "it as text, or in version 2.2."
        )
    numbers = [int(found[2][:20]) for found in _COUNTED.finditer(content)]
    if binary == b"1":
        for found in _COUNTED.finditer(content):
            count = min(int(found[2][:20]), (len(content) - found.end()) // _NODE.itemsize)
            if found[1] == b"Nodes" and count:
                numbers.append(int(np.frombuffer(content, _NODE, count, found.end())["number"].max()))
    else:
        numbers += [int(found[0][:20]) for found in _LONG.finditer(content)]
    most = max(_LARGEST, len(content))
    if max(numbers, default=0) > most:
        raise ValueError(
            f"path: {path.name[:80]} does not work as a mesh file: it counts to {max(numbers)}, and a file of its size "
            f"has {most} nodes and cells at most."
        )


def _check_counts(path: Path) -> None:
    """Raise `ValueError` for a VTK file that counts more points or cells than a file of its size has."""
    content = path.read_bytes()
    for found in _VTK_COUNTS.finditer(content):
        counts = [int(one[:20]) for one in found[2].split()]
        number = math.prod(counts) if found[1].upper() == b"DIMENSIONS" else max(counts)
        if number > max(len(content), 1000):
            raise ValueError(
                f"path: {path.name[:80]} does not work as a mesh file: it counts to {number} in {found[1].decode()}, "
                f"and has {len(content)} bytes; grids with implicit ends are not read."
            )


class _Begun(Exception):
    """The first element was reached."""


def _check_prologue(path: Path) -> None:
    """Raise `ValueError` for an XML file with a document type, which can declare entities."""
    parser = expat.ParserCreate()

    def declared(*_: Any) -> None:
        raise ValueError(f"path: {path.name[:80]} has a document type (<!DOCTYPE), which mesh files have no use for.")

    def begun(*_: Any) -> None:
        raise _Begun

    parser.StartDoctypeDeclHandler, parser.StartElementHandler = declared, begun
    try:
        with path.open("rb") as file:
            parser.ParseFile(file)
    except _Begun:
        return
    except expat.ExpatError:
        return  # meshio says what is wrong


def _check_inline(path: Path) -> None:
    """Raise `ValueError` for an XDMF file whose numbers are in other files."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError):
        return
    for item in root.iter():
        if item.tag == "DataItem" and item.get("Format") not in (None, "XML"):
            raise ValueError(
                f"path: {path.name[:80]} has its numbers in another file ({item.get('Format', '')[:20]}), which is not "
                "read; write the mesh to a .vtu file, or read it with trusted=True, where it comes from you."
            )
        if item.tag == "Information" and "<!" in (item.text or ""):
            raise ValueError(f"path: {path.name[:80]} declares entities, which mesh files have no use for.")


@contextmanager
def bounded_inflation(path: Path) -> Iterator[None]:
    """While it lasts, what meshio unpacks of a VTU file is as much as memory may hold, or it raises `ValueError`."""
    from meshio.vtu import _vtu  # takes a tenth of a second

    own, left = _vtu.__dict__, most_bytes()
    starts: dict[str, Callable[[], Any]] = {"zlib": zlib.decompressobj, "lzma": lzma.LZMADecompressor}
    modules = {name: own[name] for name in starts if name in own}

    def bounded(start: Callable[[], Any]) -> Callable[[bytes], bytes]:
        def decompress(data: bytes) -> bytes:
            nonlocal left
            out = start().decompress(data, int(left) + 1)
            left -= len(out)
            if left < 0:
                check_memory(f"{path.name[:80]}, unpacked,", most_bytes() + 1)
            return out

        return decompress

    with _reading:
        try:
            for name, module in modules.items():
                own[name] = types.SimpleNamespace(**{**vars(module), "decompress": bounded(starts[name])})
            yield
        finally:
            own.update(modules)
