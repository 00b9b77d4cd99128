"""Read and write mesh files, most of them with meshio; files are checked before they are read."""

from __future__ import annotations

import contextlib
import io
import lzma
import math
import os
import re
import threading
import types
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import ArrayLike

from jeit.files import check_memory
from jeit.files.limits import max_file_memory
from jeit.mesh import topology
from jeit.mesh.cell_quality import read_leniently
from jeit.mesh.mesh import Mesh

if TYPE_CHECKING:
    import meshio

# Formats that consist of a single file: file name extensions and meshio's names of the formats. Other formats may refer
# to further files (links in HDF5), or have readers that can loop forever on a missing bracket (Ansys, Nastran, OFF,
# PLY).
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
# Memory needed to read a mesh, divided by the size of its file.
_MEMORY_PER_FILE_BYTE = 4
_INCLUDE_PATTERN = re.compile(rb"^[ \t]*\*[ \t]*include", re.IGNORECASE | re.MULTILINE)
# First pattern: sets in an Abaqus file that are specified by their first and last number. Second pattern: counts in a
# VTK file, including the numbers of grid points along each axis.
_GENERATED_SET_PATTERN = re.compile(rb"^[ \t]*\*.*generate", re.IGNORECASE | re.MULTILINE)
_VTK_COUNTS_PATTERN = re.compile(
    rb"^[ \t]*(DIMENSIONS|POINTS|CELLS|CELL_TYPES|\w+_COORDINATES)((?:[ \t]+\d+)+)", re.IGNORECASE | re.MULTILINE
)
# For .msh files: patterns of sections that start with a count and of integers of at least eight digits, and the layout
# of a binary node.
_MSH_COUNTS_PATTERN = re.compile(rb"^\$(Nodes|Elements|PhysicalNames)\s*?\n\s*(\d+)\r?\n", re.MULTILINE)
_LONG_INTEGER_PATTERN = re.compile(rb"(?<![\w.+-])\d{8,}(?![\d.eE])")
_MSH_NODE_DTYPE = np.dtype([("number", "<i4"), ("place", "<f8", 3)])
# Maximum accepted node number: meshio allocates an array as long as the largest node number.
_MAX_NODE_NUMBER = 10**7
_reading_lock = threading.Lock()


def check_meshio_format(path: Path) -> str:
    """Name that meshio uses for the format of a file. Raises `ValueError` if the format is not in `FORMATS`, or if the
    file refers to other files, declares XML entities, or is too large for memory."""
    format_name = FORMATS.get(path.suffix.lower())
    if format_name is None:
        raise ValueError(
            f"path: {path.name[:80]} does not work as a mesh file: the ending of the name gives the format, "
            f"{', '.join(FORMATS)}. Others that meshio knows are read with trusted=True, where a file comes from you."
        )
    check_memory(path.name[:80], _MEMORY_PER_FILE_BYTE * path.stat().st_size)
    if format_name in ("vtu", "xdmf"):
        _check_prologue(path)
    if format_name == "xdmf":
        _check_xdmf_inline(path)
    if format_name == "gmsh":
        _check_msh_numbers(path)
    if format_name == "abaqus" and _INCLUDE_PATTERN.search(path.read_bytes()):
        raise ValueError(f"path: {path.name[:80]} includes another file; put all into one.")
    if format_name == "abaqus" and _GENERATED_SET_PATTERN.search(path.read_bytes()):
        raise ValueError(f"path: {path.name[:80]} has a set by its ends (GENERATE); write its members out.")
    if format_name == "vtk":
        _check_vtk_counts(path)
    return format_name


def _check_msh_numbers(path: Path) -> None:
    """Raise `ValueError` for a .msh file whose counts or node numbers are larger than a file of its size can
    contain."""
    file_bytes = path.read_bytes()
    format_version, is_binary_text = [*file_bytes[:64].split(), b"", b"", b""][1:3]
    if file_bytes.startswith(b"$MeshFormat") and is_binary_text == b"1" and not format_version.startswith(b"2"):
        raise ValueError(
            f"path: {path.name[:80]} is a binary file of Gmsh's format "
            f"{format_version[:8].decode('ascii', 'replace')}; save it as text, or in version 2.2."
        )
    declared_counts = [int(match[2][:20]) for match in _MSH_COUNTS_PATTERN.finditer(file_bytes)]
    if is_binary_text == b"1":
        for match in _MSH_COUNTS_PATTERN.finditer(file_bytes):
            num_nodes = min(int(match[2][:20]), (len(file_bytes) - match.end()) // _MSH_NODE_DTYPE.itemsize)
            if match[1] == b"Nodes" and num_nodes:
                declared_counts.append(
                    int(np.frombuffer(file_bytes, _MSH_NODE_DTYPE, num_nodes, match.end())["number"].max())
                )
    else:
        declared_counts += [int(match[0][:20]) for match in _LONG_INTEGER_PATTERN.finditer(file_bytes)]
    max_number = max(_MAX_NODE_NUMBER, len(file_bytes))
    if max(declared_counts, default=0) > max_number:
        raise ValueError(
            f"path: {path.name[:80]} does not work as a mesh file: it counts to {max(declared_counts)}, and a file of "
            f"its size has {max_number} nodes and cells at most."
        )


def _check_vtk_counts(path: Path) -> None:
    """Raise `ValueError` for a VTK file that declares more points or cells than a file of its size can contain."""
    file_bytes = path.read_bytes()
    for match in _VTK_COUNTS_PATTERN.finditer(file_bytes):
        declared_counts = [int(count_digits[:20]) for count_digits in match[2].split()]
        num_items = math.prod(declared_counts) if match[1].upper() == b"DIMENSIONS" else max(declared_counts)
        if num_items > max(len(file_bytes), 1000):
            raise ValueError(
                f"path: {path.name[:80]} does not work as a mesh file: it counts to {num_items} in "
                f"{match[1].decode()}, and has {len(file_bytes)} bytes; grids with implicit ends are not read."
            )


class _FirstElementReachedError(Exception):
    """Raised at the first XML element, to stop parsing there."""


def _check_prologue(path: Path) -> None:
    """Raise `ValueError` for an XML file with a document type, which can declare entities."""
    xml_parser = expat.ParserCreate()

    def reject_doctype(*_: Any) -> None:
        raise ValueError(f"path: {path.name[:80]} has a document type (<!DOCTYPE), which mesh files have no use for.")

    def stop_parsing(*_: Any) -> None:
        raise _FirstElementReachedError

    xml_parser.StartDoctypeDeclHandler, xml_parser.StartElementHandler = reject_doctype, stop_parsing
    try:
        with path.open("rb") as file:
            xml_parser.ParseFile(file)
    except _FirstElementReachedError:
        return
    except expat.ExpatError:
        return  # meshio reports the error


def _check_xdmf_inline(path: Path) -> None:
    """Raise `ValueError` for an XDMF file that stores its arrays in other files or declares entities."""
    try:
        root_element = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError):
        return
    for item in root_element.iter():
        if item.tag == "DataItem" and item.get("Format") not in (None, "XML"):
            raise ValueError(
                f"path: {path.name[:80]} has its numbers in another file ({item.get('Format', '')[:20]}), which is not "
                "read; write the mesh to a .vtu file, or read it with trusted=True, where it comes from you."
            )
        if item.tag == "Information" and "<!" in (item.text or ""):
            raise ValueError(f"path: {path.name[:80]} declares entities, which mesh files have no use for.")


@contextmanager
def bounded_inflation(path: Path) -> Iterator[None]:
    """Context in which meshio raises `ValueError` if the decompressed data of a VTU file exceed the memory limit."""
    from meshio.vtu import _vtu  # takes a tenth of a second

    vtu_names, num_bytes_left = _vtu.__dict__, max_file_memory()
    decompressor_types: dict[str, Callable[[], Any]] = {"zlib": zlib.decompressobj, "lzma": lzma.LZMADecompressor}
    vtu_modules = {name: vtu_names[name] for name in decompressor_types if name in vtu_names}

    def bounded_decompress(create_decompressor: Callable[[], Any]) -> Callable[[bytes], bytes]:
        def decompress_within_limit(compressed_bytes: bytes) -> bytes:
            nonlocal num_bytes_left
            decompressed_bytes = create_decompressor().decompress(compressed_bytes, int(num_bytes_left) + 1)
            num_bytes_left -= len(decompressed_bytes)
            if num_bytes_left < 0:
                check_memory(f"{path.name[:80]}, unpacked,", max_file_memory() + 1)
            return decompressed_bytes

        return decompress_within_limit

    with _reading_lock:
        try:
            for name, vtu_module in vtu_modules.items():
                vtu_names[name] = types.SimpleNamespace(
                    **{**vars(vtu_module), "decompress": bounded_decompress(decompressor_types[name])}
                )
            yield
        finally:
            vtu_names.update(vtu_modules)


_CELL_TYPES = {2: "triangle", 3: "tetra"}
_FACET_TYPES = {2: "line", 3: "triangle"}
# Formats that list triangles without connectivity, so that coincident nodes must be merged.
_FORMATS_WITHOUT_CONNECTIVITY = (".stl", ".obj")
# Exceptions that meshio raises for invalid content, and maximum number of characters of their messages.
_READ_ERRORS = (LookupError, TypeError, AttributeError, ArithmeticError, MemoryError)
_MAX_MESSAGE_LENGTH = 80


def read(path: str | Path, *, scale: float = 1.0, trusted: bool = False) -> Mesh:
    """Read a mesh of triangles (2-D) or tetrahedra (3-D) from a .vtu, .vtk, .msh (Gmsh), .inp, .xdmf or other file, or
    a surface in space from one of these formats or from a scan or CAD file (.stl, .obj; for .step see
    `jeit.mesh.from_gmsh`).

    Groups of boundary facets (Gmsh's physical groups, or meshio's cell sets) become tags. Groups without boundary
    facets and nodes without cells are omitted. A flat mesh in a plane z = constant becomes 2-D; a mesh of triangles
    that is not flat becomes a surface in space. In .stl and .obj files, coincident nodes are merged.

    **Arguments:**

    - `path`: the file.
    - `scale`: length of the file's unit in metres: 1e-3 for millimetres, 0.0254 for inches.
    - `trusted`: whether to read all formats of meshio without checks, including files that the file refers to. By
      default only the file itself is read, and only if it fits the memory limit (environment variable JEIT_FILE_GB).

    Raises `FileNotFoundError` if the file does not exist. Raises `ValueError` if the file is not a mesh file, refers to
    other files, or contains cells other than linear triangles or tetrahedra, or a mesh that `Mesh.create` rejects.

    **Example:**

    ```python
    write(mesh, "tank.msh")
    tank = read("tank.msh")
    ```
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no file {path}. Check the name and the working directory.")
    if not isinstance(scale, Real) or not 0 < scale < np.inf:
        raise ValueError(f"scale: expected the file's unit in metres, such as 1e-3 for millimetres, got {scale!r}.")
    if not path.stat().st_size:
        raise ValueError(f"path: {path.name[:80]} does not work as a mesh file: it is empty.")
    format_name = None if trusted else check_meshio_format(path)
    if path.suffix.lower() in _FORMATS_WITHOUT_CONNECTIVITY:
        points, cells = read_leniently(path, path.name[:80])
        return _create_mesh(points * float(scale), cells, {})
    with bounded_inflation(path) if format_name == "vtu" else nullcontext():
        meshio_mesh = _call_meshio(path, lambda meshio: meshio.read(path, file_format=format_name))
    try:
        return _convert_from_meshio(meshio_mesh, float(scale), path.name[:80])
    except _READ_ERRORS as error:
        raise ValueError(f"path: {path.name[:80]} holds no mesh ({_shorten_message(error)}).") from None


def write(
    mesh: Mesh,
    path: str | Path,
    *,
    cell_data: Mapping[str, ArrayLike] | None = None,
    point_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a mesh, with its tags or with values per cell and per node. The extension of the file name determines the
    format.

    `.msh` files (Gmsh 2.2) contain the tags, as physical groups, and values per node, but not values per cell. Files of
    other formats contain values per node and per cell, but not the tags. Plane meshes are written at z = 0.

    **Arguments:**

    - `mesh`: the mesh.
    - `path`: the file; its extension determines the format.
    - `cell_data`: values per cell (m, …), by name.
    - `point_data`: values per node (n, …), by name.

    Raises `ValueError` for an unknown format, and for values that are complex or whose number does not match the mesh.

    **Example:**

    ```python
    write(mesh, "tank.vtu", cell_data={"conductivity": np.ones(mesh.num_cells)})
    ```
    """
    path = Path(path)
    points = np.asarray(mesh.points, dtype=float)
    if mesh.space_dimension == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    cell_values = {
        name: _check_values_to_write("cell_data", name, values, mesh.num_cells)
        for name, values in (cell_data or {}).items()
    }
    node_values: dict[str, ArrayLike] = {
        name: _check_values_to_write("point_data", name, values, mesh.num_points)
        for name, values in (point_data or {}).items()
    }
    cell_blocks: list[Any] = [(_CELL_TYPES[mesh.dimension], np.asarray(mesh.cells))]
    block_data: dict[str, Any] = {name: [values] for name, values in cell_values.items()}
    group_data = {}
    format_options: dict[str, Any] = {}
    if path.suffix.lower() == ".msh":
        if cell_values:
            # meshio 5.3 writes values per cell into these files but cannot read them back.
            raise ValueError(
                "cell_data: .msh files keep the mesh, its tags and point_data; write values per cell to a .vtu file."
            )
        format_options = {"file_format": "gmsh22"}
        physical_groups = [np.full(mesh.num_cells, 1)]
        group_data["domain"] = np.array([1, mesh.dimension])
        for group_number, (tag, facet_indices) in enumerate(sorted(mesh.tags.items()), start=2):
            tagged_facets = np.asarray(mesh.facets)[np.asarray(facet_indices)]
            cell_blocks.append((_FACET_TYPES[mesh.dimension], tagged_facets))
            physical_groups.append(np.full(len(tagged_facets), group_number))
            group_data[tag] = np.array([group_number, mesh.dimension - 1])
        block_data["gmsh:physical"] = physical_groups
        block_data["gmsh:geometrical"] = physical_groups
    try:
        mesh_data = {"point_data": dict(node_values), "cell_data": block_data, "field_data": group_data}
        _call_meshio(
            path,
            lambda meshio: meshio.Mesh(points, cell_blocks, **mesh_data).write(path, **format_options),
            writing=True,
        )
    except OSError as error:
        raise ValueError(f"path: {path} cannot be written: {error.strerror}. Is there such a folder?") from None


def _check_values_to_write(argument_name: str, name: str, values: ArrayLike, num_entities: int) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim < 1 or len(array) != num_entities:
        entity_name = "cell" if argument_name == "cell_data" else "node"
        raise ValueError(
            f"{argument_name}: {name!r} needs one value per {entity_name}, {num_entities} in all, got shape "
            f"{array.shape}."
        )
    if np.iscomplexobj(array):
        raise ValueError(
            f"{argument_name}: {name!r} is complex, which mesh files cannot hold. Write its parts separately."
        )
    return array


def _call_meshio(path: Path, meshio_function: Any, *, writing: bool = False) -> Any:
    """Call `meshio_function` with the module meshio as its argument. Exceptions other than `OSError`, and exits of the
    interpreter, are converted to `ValueError`; what meshio prints is captured for the message."""
    import meshio  # takes a tenth of a second

    captured_output = io.StringIO()
    try:
        with contextlib.redirect_stdout(captured_output), contextlib.redirect_stderr(captured_output):
            return meshio_function(meshio)
    except OSError:
        raise
    except (Exception, SystemExit) as error:
        if "GB in memory" in str(error):
            raise
        is_meshio_error = isinstance(error, meshio.ReadError | meshio.WriteError | SystemExit)
        message = (
            _shorten_message((captured_output.getvalue().strip() or str(error)).replace(f"{path.parent}{os.sep}", ""))
            if is_meshio_error
            else ""
        )
        fault_text = message if writing and message else "its content does not fit its format, or is cut off"
        explanation_text = f", which says: {message}" if message and not writing else ""
        raise ValueError(
            f"path: {path.name[:80]} does not work as a mesh file: {fault_text}. The ending of the name gives the "
            f"format: .vtu, .vtk, .msh, .inp and others that meshio knows{explanation_text}."
        ) from None


def _shorten_message(error: BaseException | str) -> str:
    """Shorten an error message of meshio to one line."""
    message = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return message if len(message) <= _MAX_MESSAGE_LENGTH else f"{message[: _MAX_MESSAGE_LENGTH - 1]}…"


def _convert_from_meshio(meshio_mesh: meshio.Mesh, unit_scale: float, source_name: str) -> Mesh:
    cell_types = {cell_block.type for cell_block in meshio_mesh.cells}
    dimension = 3 if "tetra" in cell_types else 2
    if not cell_types:
        raise ValueError(f"path: {source_name} does not work as a mesh file: there are no cells in it.")
    if _CELL_TYPES[dimension] not in cell_types:
        raise ValueError(
            f"path: {source_name} holds cells of type {sorted(cell_types)}, but jeit needs linear triangles or "
            "tetrahedra. Save it with elements of order 1 and without quadrilaterals or hexahedra."
        )
    if unsupported_types := cell_types & ({"quad"} if dimension == 2 else {"hexahedron", "wedge", "pyramid"}):
        raise ValueError(
            f"path: {source_name} mixes in cells of type {sorted(unsupported_types)}. Split them into simplices first."
        )
    points = np.asarray(meshio_mesh.points, dtype=float) * unit_scale
    cells = np.concatenate(
        [cell_block.data for cell_block in meshio_mesh.cells if cell_block.type == _CELL_TYPES[dimension]]
    )
    used_points, renumbered_cells = np.unique(cells, return_inverse=True)
    cells = renumbered_cells.reshape(cells.shape)
    points = points[used_points]
    new_node_index = np.full(len(meshio_mesh.points), -1)
    new_node_index[used_points] = np.arange(len(used_points))
    # The cells are not yet oriented, so boundary facets are identified as the facets that occur once.
    facet_node_keys, num_occurrences = np.unique(
        topology.facet_keys(topology.cell_facets(cells), len(used_points)), return_counts=True
    )
    boundary_facets = facet_node_keys[num_occurrences == 1]
    facet_tags = {}
    for name, facets in _facet_groups(meshio_mesh, _FACET_TYPES[dimension]).items():
        nodes = new_node_index[facets]
        nodes = nodes[(nodes >= 0).all(axis=1)]
        nodes = nodes[np.isin(topology.facet_keys(nodes, len(used_points)), boundary_facets)]
        if len(nodes):
            facet_tags[name] = nodes
    return _create_mesh(points, cells, facet_tags)


def _create_mesh(points: np.ndarray, cells: np.ndarray, facet_tags: Mapping[str, ArrayLike]) -> Mesh:
    """Create a mesh, which is two-dimensional if its triangles lie in a plane z = constant."""
    if cells.shape[1] == 3 and points.shape[1] == 3 and np.ptp(points[:, 2]) <= 1e-9 * np.ptp(points, axis=0).max():
        points = points[:, :2]
    return Mesh.create(points, cells, tags=facet_tags)


def _facet_groups(meshio_mesh: meshio.Mesh, facet_type: str) -> dict[str, np.ndarray]:
    """Nodes (t, d) of the facets in each named group of a mesh file."""
    facets_by_group: dict[str, list[np.ndarray]] = {}
    facet_dimension = 2 if facet_type == "triangle" else 1
    group_names = {
        int(number_and_dimension[0]): name
        for name, number_and_dimension in meshio_mesh.field_data.items()
        if int(number_and_dimension[1]) == facet_dimension
    }
    physical_groups = meshio_mesh.cell_data.get("gmsh:physical", [])
    for cell_block, group_numbers in zip(meshio_mesh.cells, physical_groups, strict=False):
        if cell_block.type != facet_type:
            continue
        for group_number in np.unique(group_numbers):
            if group_number > 0:
                name = group_names.get(int(group_number), f"physical_{group_number}")
                facets_by_group.setdefault(name, []).append(cell_block.data[np.asarray(group_numbers) == group_number])
    if not facets_by_group:
        for name, set_members_by_type in meshio_mesh.cell_sets.items():
            for cell_block, set_members in zip(meshio_mesh.cells, set_members_by_type, strict=False):
                if cell_block.type == facet_type and np.size(set_members) and not name.startswith("gmsh:"):
                    facets_by_group.setdefault(name, []).append(cell_block.data[np.asarray(set_members)])
    return {name: np.concatenate(facets) for name, facets in facets_by_group.items()}
