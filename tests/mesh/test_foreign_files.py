"""Untrusted mesh files: only the file itself is read, within the memory limit, and every fault is a `ValueError`."""

import signal
import warnings
import zlib

import meshio
import numpy as np
import pytest

from jeit.mesh import disk, from_gmsh, read
from jeit.mesh.files import FORMATS

MESH = disk(0.1, num_points=40)
POINTS = np.column_stack([np.asarray(MESH.points), np.zeros(MESH.num_points)])
BOMB = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>'
VTU = '<VTKFile type="UnstructuredGrid" version="1.0"><UnstructuredGrid></UnstructuredGrid></VTKFile>'
XDMF = (
    '<Xdmf Version="3.0"><Domain><Grid><Geometry GeometryType="XY"><DataItem DataType="Float" Dimensions="4 2" '
    'Format="{}">{}</DataItem></Geometry></Grid></Domain></Xdmf>'
)


@pytest.fixture(autouse=True)
def ten_second_limit():
    """Stop a reader that does not end."""

    def stop(*_):
        raise TimeoutError("ten seconds are over")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def refusal(path):
    """Return the error message if a file is refused, and an empty text if it is read. Any exception but `ValueError` is
    raised."""
    try:
        read(path)
    except ValueError as error:
        return str(error)
    return ""


def refused(path):
    message = refusal(path)
    assert 0 < len(message) <= 400
    return message


UNFIT = (
    "its content does not fit its format, or is cut off. The ending of the name gives the format: .vtu, .vtk, .msh, "
    ".inp and others that meshio knows"
)
LEADING = {
    "entities": ("a.vtu", BOMB + VTU, "document type"),
    "entities in UTF-16": (
        "a.vtu",
        ('<?xml version="1.0" encoding="UTF-16"?>' + BOMB + VTU).encode("utf-16"),
        "document",
    ),
    "entities outside": ("a.xdmf", '<!DOCTYPE x SYSTEM "file:///etc/passwd">' + XDMF, "document type"),
    "entities within": (
        "a.xdmf",
        XDMF.format("XML", "1 2").replace("<Geometry", f"<Information><![CDATA[{BOMB}<x/>]]></Information><Geometry"),
        "declares entities",
    ),
    "HDF5": ("a.xdmf", XDMF.format("HDF", "../secret.h5:/a"), "its numbers in another file"),
    "bytes of a file": ("a.xmf", XDMF.format("Binary", "secret.txt"), "its numbers in another file"),
    "another file": ("a.inp", "*HEADING\n * Include, input=secret.inp\n", "includes another file"),
    "a format of links": ("a.med", "x", "does not work as a mesh file"),
    "siblings": ("a.xml", "<dolfin/>", "does not work as a mesh file"),
    "packed": ("a.vol.gz", b"\x1f\x8b", "does not work as a mesh file"),
    "an open bracket": ("a.msh", "(10 (0 1 2 0)\n(10 (1", "does not work as a mesh file"),
    "a header without an end": ("a.ply", "ply\nformat ascii 1.0\n", "does not work as a mesh file"),
    "no end of comments": ("a.off", "OFF\n#\n", "does not work as a mesh file"),
    "nodes without end": (
        "a.msh",
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4000000000\n",
        "counts to 4000000000",
    ),
    "bytes without end": (
        "a.msh",
        b"$MeshFormat\n2.2 1 8\n\1\0\0\0\n$EndMeshFormat\n$Nodes\n1\n" + np.int32(2**31 - 1).tobytes() + bytes(24),
        "counts to 2147483647",
    ),
    "a large number of a node": (
        "a.msh",
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n1\n999999999 0 0 0\n$EndNodes\n",
        "counts to 999999999",
    ),
    "no end of data": ("a.nas", "BEGIN BULK\n", "does not work as a mesh file"),
    "no text": ("a.msh", bytes(range(256)), "does not work as a mesh file"),
    "nothing": ("a.vtk", "", "does not work as a mesh file: it is empty"),
    "no mesh at all": ("a.msh", "hello", f"file: {UNFIT}, which says: Error: Couldn't read file a.msh as gmsh."),
    "no triangles": ("a.stl", "hello\n", "text that begins with 'solid' nor as long as its number of triangles asks."),
    "no cells": ("a.inp", "hello", "does not work as a mesh file: there are no cells in it"),
    "cut off": (
        "a.msh",
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n3\n1 0 0 0\n2 1 0",
        "does not work as a mesh file: its content does not fit its format, or is cut off. The ending",
    ),
}


@pytest.mark.parametrize("name", LEADING)
def test_references_to_other_files_are_refused(name, tmp_path):
    file, content, message = LEADING[name]
    (tmp_path / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "secret.inp").write_text("*NODE\n1, 0, 0\n2, 1, 0\n3, 0, 1\n*ELEMENT, TYPE=CPS3\n1, 1, 2, 3\n")
    assert message in refused(tmp_path / file)


@pytest.mark.parametrize("compressor", ["zlib", "lzma"])
def test_compressed_data_are_unpacked_within_the_memory_limit(compressor, tmp_path, monkeypatch):
    meshio.Mesh(POINTS, [("triangle", np.asarray(MESH.cells))]).write(tmp_path / "a.vtu", compression=compressor)
    assert read(tmp_path / "a.vtu").num_cells == MESH.num_cells
    large = np.zeros((100_000, 3))
    meshio.Mesh(large, [("triangle", np.zeros((1, 3), int))]).write(tmp_path / "b.vtu", compression=compressor)
    monkeypatch.setenv("JEIT_FILE_GB", "0.002")
    assert (tmp_path / "b.vtu").stat().st_size < 5e5
    assert "b.vtu, unpacked, would take" in refused(tmp_path / "b.vtu")
    assert meshio.vtu._vtu.zlib is zlib  # as before


def test_a_file_larger_than_memory_is_not_opened(tmp_path, monkeypatch):
    (tmp_path / "a.msh").write_bytes(bytes(10_000))
    monkeypatch.setenv("JEIT_FILE_GB", "0.00001")
    assert "a.msh would take" in refused(tmp_path / "a.msh")


TEXTS = {
    ".su2": "NDIME= 2\nNELEM= 1\n5 0 1 2 0\nNPOIN= 3\n0 0 0\n1 0 1\n0 1 2\nNMARK= 0\n",
    ".xdmf": XDMF.format("XML", "0 0 1 0 1 1 0 1"),
    ".xmf": XDMF.format("XML", "0 0 1 0 1 1 0 1"),
}


@pytest.mark.parametrize("suffix", [*FORMATS])
def test_truncated_and_corrupted_files(suffix, tmp_path):
    """Truncated anywhere or with any bytes changed, a file gives a mesh or a `ValueError`."""
    path = tmp_path / f"a{suffix}"
    if suffix in TEXTS:
        path.write_text(TEXTS[suffix])
    else:
        options = {"file_format": "gmsh22"} if suffix == ".msh" else {}
        meshio.Mesh(POINTS, [("triangle", np.asarray(MESH.cells))]).write(path, **options)
    content, random = path.read_bytes(), np.random.default_rng(0)
    changed = [content[: int(part * len(content))] for part in np.linspace(0, 1, 15)]
    for _ in range(25):
        other = bytearray(content)
        for place in random.integers(0, len(other), 3):
            other[place] = random.integers(0, 256)
        changed.append(bytes(other))
    for one in changed:
        path.write_bytes(one)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # large coordinates
            message = refusal(path)
        assert len(message) <= 400, message


@pytest.mark.parametrize("name", ["a.geo", "a.msh", "a.opt", "a"])
def test_scripts_of_gmsh_are_not_run(name, tmp_path):
    (tmp_path / name).write_text(f'SystemCall "touch {tmp_path}/ran";')
    with pytest.raises(ValueError, match=r"may be a script of Gmsh's.*scripts=True"):
        from_gmsh(tmp_path / name)
    assert not (tmp_path / "ran").exists()
