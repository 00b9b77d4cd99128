"""Images: conductivity, or its change, on the mesh or on a raster."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.tri import Triangulation
from numpy.typing import ArrayLike

from jeit.electrodes import AbstractElectrodes
from jeit.image import Inclusion, Raster
from jeit.mesh import Mesh
from jeit.plot.axes import (
    DIVERGING,
    SEQUENTIAL,
    axes_or_new,
    bare,
    draw_colour_bar,
    draw_scale_bar,
    extent_of,
    prefixed,
)
from jeit.plot.imaging.electrodes import draw_electrodes
from jeit.plot.imaging.inclusions import draw_inclusions
from jeit.plot.imaging.mesh import draw_outline


def plot_image(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | None = None,
    *,
    difference: bool = True,
    unit: str | None = None,
    quantity: str | None = None,
    inclusions: Sequence[Inclusion] = (),
    limit: float | None = None,
    colour_map: str | None = None,
    title: str | None = None,
    height: float | None = None,
    colour_bar: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw `values` on the mesh: per cell (m,), flat; or per node (n,), shaded.

    `difference`: values are changes, drawn on a diverging map centred at zero; otherwise on a perceptually uniform
    sequential one. `electrodes` are drawn at their place and width, and numbered. `unit`: of the values, "S" on 2-D
    meshes and "S/m" on 3-D ones unless given; the colour bar finds the prefix. `quantity`: what the colour bar says.
    `inclusions`: marked. `limit`: value at the end of the colour bar, in `unit`. `height`: z in metres of the
    slice through a 3-D mesh, half way up unless given. `colour_bar`: whether to draw one. Raises `ValueError` for
    values of another shape.
    """
    image = np.asarray(values)
    if image.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {image.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(image):
        raise ValueError("values are complex; draw their real or imaginary part.")
    per_cell = image.shape == (mesh.num_cells,)
    ax = axes_or_new(ax)
    if mesh.dimension == 3:
        raster = Raster.create(mesh, height=height)
        pixels = np.asarray(
            raster.sample(jnp.asarray(image if per_cell else image[np.asarray(mesh.cells)].mean(axis=1)))
        )
        extent = raster.extent
        shown = pixels[np.isfinite(pixels)]
        if not shown.size:
            raise ValueError(f"height: there is no mesh at z = {height} m to cut through.")
        factor, label, colours = _colours(
            shown, difference, "S/m" if unit is None else unit, quantity, limit, colour_map
        )
        drawn = ax.imshow(factor * pixels, extent=extent, interpolation="nearest", **colours)
    else:
        points = np.asarray(mesh.points)
        extent = extent_of(points)
        triangles = Triangulation(points[:, 0], points[:, 1], np.asarray(mesh.cells))
        factor, label, colours = _colours(image, difference, "S" if unit is None else unit, quantity, limit, colour_map)
        # Cell edges in the cells' own colour: without them the background shines through the seams.
        style = {"shading": "flat", "edgecolors": "face", "linewidth": 0.5} if per_cell else {"shading": "gouraud"}
        drawn = ax.tripcolor(triangles, factor * image, **style, **colours)
    _dress(ax, mesh, electrodes, inclusions, extent, title)
    if colour_bar:
        draw_colour_bar(ax, drawn, label, signed=difference)
    return ax


def plot_raster(
    raster: ArrayLike,
    extent: tuple[float, float, float, float],
    *,
    mesh: Mesh | None = None,
    electrodes: AbstractElectrodes | None = None,
    difference: bool = True,
    unit: str = "S",
    quantity: str | None = None,
    inclusions: Sequence[Inclusion] = (),
    limit: float | None = None,
    colour_map: str | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a raster (rows, columns), row 0 at the top, NaN left blank; arguments as in `plot_image`.

    `extent`: (x_min, x_max, y_min, y_max) in metres. `mesh`: the mesh it was sampled from, for its
    outline and the `electrodes`.
    """
    pixels = np.asarray(raster)
    shown = pixels[np.isfinite(pixels)]
    if pixels.ndim != 2 or shown.size == 0:
        raise ValueError(f"raster has shape {pixels.shape}; give (rows, columns) with at least one finite value.")
    if electrodes is not None and mesh is None:
        raise ValueError("electrodes are drawn along the boundary of a mesh: give mesh, the one the raster is of.")
    factor, label, colours = _colours(shown, difference, unit, quantity, limit, colour_map)
    ax = axes_or_new(ax)
    drawn = ax.imshow(factor * pixels, extent=extent, interpolation="nearest", **colours)
    _dress(ax, mesh, electrodes, inclusions, extent, title)
    draw_colour_bar(ax, drawn, label, signed=difference)
    return ax


def _colours(shown: np.ndarray, difference: bool, unit: str, quantity, limit: float | None, colour_map: str | None):
    """Factor to the unit on the colour bar, the bar's label, and keywords for matplotlib."""
    largest = float(np.abs(shown).max()) if limit is None else float(limit)
    if not (np.isfinite(largest) and largest >= 0):
        raise ValueError("values must be finite to be drawn, and limit positive.")
    factor, with_prefix = prefixed(largest, unit)
    high = factor * largest or 1.0
    if difference:
        low = -high
    else:
        low = factor * float(shown.min())
        if low >= high:  # a constant image
            low, high = low - 0.05 * abs(low) - 1e-12, high + 0.05 * abs(high) + 1e-12
    sheet = "sheet conductivity" if unit == "S" else "conductivity"
    what = quantity or (f"Change of {sheet}" if difference else sheet.capitalize())
    colours = {"cmap": colour_map or (DIVERGING if difference else SEQUENTIAL), "vmin": low, "vmax": high}
    return factor, f"{what} ({with_prefix})" if with_prefix else what, colours


def _dress(ax: Axes, mesh: Mesh | None, electrodes, inclusions, extent, title: str | None) -> None:
    if mesh is not None and mesh.dimension == 2:
        draw_outline(mesh, ax)
    if mesh is not None and electrodes is not None:
        draw_electrodes(mesh, electrodes, ax=ax)
    draw_inclusions(inclusions, ax=ax)
    bare(ax, extent)
    draw_scale_bar(ax, extent)
    if title:
        ax.set_title(title)
