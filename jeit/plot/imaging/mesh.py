"""Meshes: their cells, their outline, their electrodes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from jeit.arguments import check_kind
from jeit.electrodes import AbstractElectrodes
from jeit.mesh import Mesh, check_flat
from jeit.plot.axes import INK, SOFT, axes_or_new, bare, draw_scale_bar, extent_of
from jeit.plot.imaging.electrodes import draw_electrodes


def plot_mesh(
    mesh: Mesh, electrodes: AbstractElectrodes | None = None, *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw a 2-D mesh with its outline, and `electrodes` numbered; of a 3-D mesh its surface, seen from above.

    Raises `ValueError` for what is neither.
    """
    check_body(mesh, electrodes)
    ax = axes_or_new(ax)
    points = np.asarray(mesh.points)
    triangles = np.asarray(mesh.cells if mesh.dimension == 2 else mesh.facets)
    ax.triplot(points[:, 0], points[:, 1], triangles, color=SOFT, linewidth=0.7)
    if mesh.dimension == 2:
        draw_outline(mesh, ax)
    if electrodes is not None:
        draw_electrodes(mesh, electrodes, ax=ax)
    extent = extent_of(points)
    bare(ax, extent)
    draw_scale_bar(ax, extent)
    ax.set_title(f"{mesh.num_points:,} nodes, {mesh.num_cells:,} cells" if title is None else title)
    return ax


def check_body(mesh: Mesh, electrodes: AbstractElectrodes | None) -> None:
    """Raises `ValueError` for what is no mesh, a surface in space, and what are no electrodes, if any are given."""
    check_kind("mesh", mesh, Mesh, "a Mesh, such as Disk(0.05).mesh()")
    check_flat(mesh, "pictures seen from above")
    if electrodes is not None:
        check_kind("electrodes", electrodes, AbstractElectrodes, "those of jeit.electrodes, such as BoundaryElectrodes")


def draw_outline(mesh: Mesh, ax: Axes) -> None:
    """The boundary of a 2-D mesh, holes included."""
    edges = np.asarray(mesh.points)[np.asarray(mesh.facets)]
    ax.add_collection(LineCollection(list(edges), colors=INK, linewidths=0.9, capstyle="round", zorder=2))


def draw_slice_outline(
    pixels: Float[np.ndarray, "rows columns"], extent: tuple[float, float, float, float], ax: Axes
) -> None:
    """The edge of a slice through a solid, sampled on `pixels`, NaN outside it; `extent` in metres."""
    # A rim of nothing all round, for the edge to be closed where it touches the picture's.
    shown = np.pad(np.isfinite(pixels).astype(float), 1)
    width, height = (extent[1] - extent[0]) / pixels.shape[1], (extent[3] - extent[2]) / pixels.shape[0]
    wider = (extent[0] - width, extent[1] + width, extent[2] - height, extent[3] + height)
    ax.contour(shown, [0.5], extent=wider, origin="upper", colors=INK, linewidths=0.9, zorder=2)


def slice_text(mesh: Mesh, height: float | None = None, what: str = "slice") -> str:
    """Text of the height of a slice, z = `height` metres or half way up: "slice at z = 20.0 mm"; empty for a plane
    mesh."""
    if mesh.dimension == 2:
        return ""
    z = np.asarray(mesh.points)[:, 2]
    return f"{what} at z = {1e3 * ((z.min() + z.max()) / 2 if height is None else height):.1f} mm"
