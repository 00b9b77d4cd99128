"""Images: conductivity, or its change, on the mesh or on a raster."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.tri import Triangulation
from numpy.typing import ArrayLike

from jeit.electrodes import AbstractElectrodes
from jeit.image import Inclusion, Raster
from jeit.mesh import Mesh
from jeit.plot.axes import axes_or_new, bare, draw_scale_bar, extent_of
from jeit.plot.colour_scale import CHANGE, ColourScale, check_scale
from jeit.plot.imaging.electrodes import draw_electrodes, draw_inclusions
from jeit.plot.imaging.mesh import check_body, draw_outline, draw_slice_outline


def plot_image(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | None = None,
    *,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE,
    title: str | None = None,
    height: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw `values` on the mesh: per cell (m,), flat; or per node (n,), shaded.

    `electrodes` are drawn at their place and width, and numbered. `inclusions`: marked. `scale`: how values become
    colours; values are changes of conductivity in S (3-D: S/m) unless it says otherwise, as `ColourScale(difference=
    False)` does for conductivity itself. `height`: z in metres of the slice through a 3-D mesh, half way up unless
    given. Raises `ValueError` for values of another shape, complex or not finite, a height beside the mesh, and things
    of another kind.
    """
    check_body(mesh, electrodes)
    check_scale(scale)
    image = np.asarray(values)
    if image.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {image.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(image):
        raise ValueError("values are complex; draw their real or imaginary part.")
    ax = axes_or_new(ax)
    if mesh.dimension == 3:
        per_cell = image if image.shape == (mesh.num_cells,) else image[np.asarray(mesh.cells)].mean(axis=1)
        raster = Raster.create(mesh, height=height)
        pixels, extent = np.asarray(raster.sample(jnp.asarray(per_cell))), raster.extent
        if not np.isfinite(pixels).any():
            raise ValueError(f"height: there is no mesh at z = {height} m to cut through.")
        colours = scale.of(pixels[np.isfinite(pixels)], "S/m")
        drawn = ax.imshow(colours.factor * pixels, extent=extent, interpolation="nearest", **colours.keywords)
        draw_slice_outline(pixels, extent, ax)
    else:
        points = np.asarray(mesh.points)
        extent = extent_of(points)
        triangles = Triangulation(points[:, 0], points[:, 1], np.asarray(mesh.cells))
        colours = scale.of(image, "S")
        # Cell edges in the cells' own colour: without them the background shines through the seams.
        flat = {"shading": "flat", "edgecolors": "face", "linewidth": 0.5}
        style = flat if image.shape == (mesh.num_cells,) else {"shading": "gouraud"}
        drawn = ax.tripcolor(triangles, colours.factor * image, **style, **colours.keywords)
    _dress(ax, mesh, electrodes, inclusions, extent, title)
    colours.draw_bar(ax, drawn)
    return ax


def plot_raster(
    raster: ArrayLike,
    extent: tuple[float, float, float, float],
    *,
    mesh: Mesh | None = None,
    electrodes: AbstractElectrodes | None = None,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a raster (rows, columns), row 0 at the top, NaN left blank; arguments as in `plot_image`.

    `extent`: (x_min, x_max, y_min, y_max) in metres. `mesh`: the mesh it was sampled from, for its outline and the
    `electrodes`. Raises `ValueError` for a raster without a finite value, for electrodes without their mesh, and for
    things of another kind.
    """
    check_scale(scale)
    if mesh is not None:
        check_body(mesh, electrodes)
    pixels = np.asarray(raster)
    shown = pixels[np.isfinite(pixels)]
    if pixels.ndim != 2 or shown.size == 0:
        raise ValueError(f"raster has shape {pixels.shape}; give (rows, columns) with at least one finite value.")
    if electrodes is not None and mesh is None:
        raise ValueError("electrodes are drawn along the boundary of a mesh: give mesh, the one the raster is of.")
    colours = scale.of(shown, "S")
    ax = axes_or_new(ax)
    drawn = ax.imshow(colours.factor * pixels, extent=extent, interpolation="nearest", **colours.keywords)
    _dress(ax, mesh, electrodes, inclusions, extent, title)
    colours.draw_bar(ax, drawn)
    return ax


def _dress(ax: Axes, mesh: Mesh | None, electrodes, inclusions, extent, title: str | None) -> None:
    if mesh is not None and mesh.dimension == 2:
        draw_outline(mesh, ax)
    if mesh is not None and electrodes is not None:
        draw_electrodes(mesh, electrodes, ax=ax)
    draw_inclusions(inclusions, ax=ax)
    bare(ax, extent, numbered=electrodes is not None)
    draw_scale_bar(ax, extent)
    if title:
        ax.set_title(title)
