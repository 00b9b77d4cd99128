"""Files of images for other programs: VTU, time series of VTU files (PVD), and XDMF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, describe, is_number
from jeit.electrodes import AbstractElectrodes
from jeit.files import atomically_written_files
from jeit.mesh import Mesh, write
from jeit.mesh.mesh import facet_measures
from jeit.report.folder import results_folder

# Minimum fraction of the surface around a node that an electrode covers if the node belongs to the electrode.
_MIN_COVERED_SHARE = 0.1


def write_vtu(
    path: str | Path,
    mesh: Mesh,
    cell_data: Mapping[str, ArrayLike],
    *,
    point_data: Mapping[str, ArrayLike] | None = None,
    electrodes: AbstractElectrodes | None = None,
) -> None:
    """Write a mesh with values per cell and per node as a VTU file; complex values are written as two arrays. Lengths
    are in metres.

    **Arguments:**

    - `path`: the .vtu file.
    - `mesh`: the mesh.
    - `cell_data`: values per cell (m,), by name.
    - `point_data`: values per node (n,), by name.
    - `electrodes`: written as the array "electrode", the number of the electrode at each node, from 1, and 0 for other
      nodes.

    Raises `ValueError` for a suffix other than .vtu, values of a wrong length, and a path that cannot be written to.

    **Example:**

    ```python
    write_vtu("image.vtu", mesh, {"change": np.ones(mesh.num_cells)})
    ```
    """
    path = Path(path)
    if path.suffix.lower() != ".vtu":
        raise ValueError(f"path: {path.name[:80]} must end in .vtu.")
    with atomically_written_files(results_folder(path.parent, (path.name,))) as temporary_folder:
        draft_vtu(temporary_folder / path.name, mesh, cell_data, point_data=point_data, electrodes=electrodes)


def draft_vtu(
    path: Path,
    mesh: Mesh,
    cell_data: Mapping[str, ArrayLike],
    *,
    point_data: Mapping[str, ArrayLike] | None = None,
    electrodes: AbstractElectrodes | None = None,
) -> None:
    """Write a VTU file as `write_vtu` does, but directly to `path`, for example into the temporary folder that
    `results` yields."""
    point_arrays = dict(point_data or {})
    if electrodes is not None:
        point_arrays["electrode"] = electrode_of_nodes(mesh, electrodes)
    write(mesh, path, cell_data=_real_arrays(cell_data), point_data=_real_arrays(point_arrays))


def write_vtk_series(path: str | Path, mesh: Mesh, times: ArrayLike, cell_data: Mapping[str, ArrayLike]) -> None:
    """Write a time series of images as a .pvd file, which ParaView opens, and one VTU file for each frame.

    The VTU files are named after the series, such as `breath_0000.vtu`. Either all files are written or none.

    **Arguments:**

    - `path`: the .pvd file.
    - `mesh`: the mesh.
    - `times` (F,): seconds.
    - `cell_data`: values per frame and cell (F, m), by name.

    Raises `ValueError` for a suffix other than .pvd, and for arrays that do not fit together.

    **Example:**

    ```python
    write_vtk_series("breath.pvd", mesh, [0.0, 0.1], {"change": np.zeros((2, mesh.num_cells))})
    ```
    """
    path = Path(path)
    if path.suffix.lower() != ".pvd":
        raise ValueError(f"path: {path.name[:80]} must end in .pvd.")
    frame_times, cell_values = _checked_frames(mesh, times, cell_data)
    vtu_names = [f"{path.stem}_{frame_number:04d}.vtu" for frame_number in range(len(frame_times))]
    file_entries = [
        f'    <DataSet timestep="{time:.17g}" part="0" file={quoteattr(name)}/>'
        for time, name in zip(frame_times, vtu_names, strict=True)
    ]
    pvd_lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="Collection" version="0.1">',
        "  <Collection>",
        *file_entries,
        "  </Collection>",
        "</VTKFile>",
    ]
    with atomically_written_files(results_folder(path.parent, (path.name, *vtu_names))) as temporary_folder:
        for frame_number, name in enumerate(vtu_names):
            draft_vtu(temporary_folder / name, mesh, {key: array[frame_number] for key, array in cell_values.items()})
        (temporary_folder / path.name).write_text("\n".join(pvd_lines) + "\n", "utf-8")


def write_xdmf(path: str | Path, mesh: Mesh, times: ArrayLike, cell_data: Mapping[str, ArrayLike]) -> None:
    """Write a time series of images as a single XDMF file in text format.

    **Arguments:**

    - `path`: the .xdmf file.
    - `mesh`, `times`, `cell_data`: as for `write_vtk_series`.

    Raises `ValueError` for a suffix other than .xdmf, and for arrays that do not fit together.

    **Example:**

    ```python
    write_xdmf("breath.xdmf", mesh, [0.0, 0.1], {"change": np.zeros((2, mesh.num_cells))})
    ```
    """
    from meshio.xdmf import TimeSeriesWriter

    path = Path(path)
    if path.suffix.lower() != ".xdmf":
        raise ValueError(f"path: {path.name[:80]} must end in .xdmf.")
    frame_times, cell_values = _checked_frames(mesh, times, cell_data)
    points = np.asarray(mesh.points, float)
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    cell_type = {3: "triangle", 4: "tetra"}[mesh.cells.shape[1]]
    folder = results_folder(path.parent, (path.name,))
    with (
        atomically_written_files(folder) as temporary_folder,
        TimeSeriesWriter(str(temporary_folder / path.name), data_format="XML") as file,
    ):
        file.write_points_cells(points, [(cell_type, np.asarray(mesh.cells))])
        for frame_number, time in enumerate(frame_times):
            file.write_data(float(time), cell_data={key: [array[frame_number]] for key, array in cell_values.items()})


def electrode_of_nodes(mesh: Mesh, electrodes: AbstractElectrodes) -> Int[np.ndarray, " n"]:
    """Number, from 1, of the electrode at each node of a mesh (n,); 0 for nodes without an electrode."""
    contact = electrodes.contact(mesh)
    node_shares = np.asarray(contact.load)
    if not electrodes.is_point:
        node_shares = node_shares * np.asarray(electrodes.contact_impedance)
        contact_facets = np.asarray(contact.nodes[0])
        if len(contact.nodes) == 1 and contact_facets.shape == np.shape(mesh.facets):
            node_measures_per_facet = np.repeat(
                np.asarray(facet_measures(mesh)) / contact_facets.shape[1], contact_facets.shape[1]
            )
            node_measures = np.bincount(contact_facets.ravel(), node_measures_per_facet, mesh.num_points)
            node_shares = node_shares / np.where(node_measures > 0, node_measures, np.inf)[:, None]
        else:
            node_shares = node_shares / node_shares.max(axis=0)
    return np.where(node_shares.max(axis=1) > _MIN_COVERED_SHARE, node_shares.argmax(axis=1) + 1, 0)


def _real_arrays(arrays_by_name: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """Replace complex arrays by two arrays, their real and imaginary part."""
    real_arrays = {}
    for name, values in arrays_by_name.items():
        array: Any = np.asarray(values)
        if np.iscomplexobj(array):
            real_arrays[f"{name}, real"], real_arrays[f"{name}, imaginary"] = array.real, array.imag
        else:
            real_arrays[name] = array
    return real_arrays


def _checked_frames(
    mesh: Mesh, times: ArrayLike, cell_data: Mapping[str, ArrayLike]
) -> tuple[np.ndarray, dict[str, Any]]:
    """Check the times and values of a series, and return them as arrays. Raises `ValueError` if they do not fit the
    mesh and each other."""
    check_kind("mesh", mesh, Mesh, "a Mesh, such as Disk(0.05).mesh()")
    frame_times: Sequence | np.ndarray = np.atleast_1d(np.asarray(times, dtype=object))
    if len(frame_times) == 0 or not all(is_number(time) for time in frame_times):
        raise ValueError(f"times must be a time for each frame, seconds; they are {describe(times)}.")
    frame_times = np.asarray(frame_times, float)
    if not (np.diff(frame_times) > 0).all():
        raise ValueError("times must rise from frame to frame.")
    cell_values = _real_arrays(cell_data)
    for name, array in cell_values.items():
        if array.shape != (len(frame_times), mesh.num_cells):
            raise ValueError(
                f"cell_data: {str(name)[:40]!r} has shape {array.shape}; give one value for each of the "
                f"{len(frame_times)} times and {mesh.num_cells} cells."
            )
    if not cell_values:
        raise ValueError("cell_data is empty; give the values of the frames by name.")
    return frame_times, cell_values
