"""Plots of meshes and of images on them: conductivity, its change, complex admittivity, and sensitivity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes import AbstractElectrodes
from jeit.forward import ForwardModel
from jeit.image import Inclusion, Raster
from jeit.mesh import Mesh, check_flat, measures
from jeit.plot.axes import draw_scale_bar, extent_of, get_or_create_axes, hide_axes
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, LIGHT_GREY, ColourScale, check_scale
from jeit.plot.imaging.electrodes import draw_electrodes, draw_inclusions


def plot_mesh(
    mesh: Mesh, electrodes: AbstractElectrodes | None = None, *, title: str | None = None, ax: Axes | None = None
) -> Axes:
    """Draw a 2-D mesh with its outline, or the surface of a 3-D mesh as seen from above.

    **Arguments:**

    - `mesh`: the mesh.
    - `electrodes`: electrodes, which are drawn to scale and numbered.
    - `title`: title of the plot.
    - `ax`: axes to draw in; default: new axes.

    Raises `ValueError` for arguments of a wrong type, and for a surface in space.

    **Example:**

    ```python
    plot_mesh(mesh, electrodes)
    ```
    """
    check_body(mesh, electrodes)
    ax = get_or_create_axes(ax)
    points = np.asarray(mesh.points)
    triangles = np.asarray(mesh.cells if mesh.dimension == 2 else mesh.facets)
    ax.triplot(points[:, 0], points[:, 1], triangles, color=LIGHT_GREY, linewidth=0.7)
    if mesh.dimension == 2:
        draw_outline(mesh, ax)
    if electrodes is not None:
        draw_electrodes(mesh, electrodes, ax=ax)
    extent = extent_of(points)
    hide_axes(ax, extent)
    draw_scale_bar(ax, extent)
    ax.set_title(f"{mesh.num_points:,} nodes, {mesh.num_cells:,} cells" if title is None else title)
    return ax


def check_body(mesh: Mesh, electrodes: AbstractElectrodes | None) -> None:
    """Check a mesh and, if given, electrodes. Raises `ValueError` for objects of a wrong type, and for a surface in
    space."""
    check_kind("mesh", mesh, Mesh, "a Mesh, such as Disk(0.05).mesh()")
    check_flat(mesh, "pictures seen from above")
    if electrodes is not None:
        check_kind("electrodes", electrodes, AbstractElectrodes, "those of jeit.electrodes, such as BoundaryElectrodes")


def draw_outline(mesh: Mesh, ax: Axes) -> None:
    """Draw the boundary of a 2-D mesh, including holes."""
    boundary_edges = np.asarray(mesh.points)[np.asarray(mesh.facets)]
    ax.add_collection(
        LineCollection(list(boundary_edges), colors=DARK_GREY, linewidths=0.9, capstyle="round", zorder=2)
    )


def draw_slice_outline(
    pixels: Float[np.ndarray, "rows columns"], extent: tuple[float, float, float, float], ax: Axes
) -> None:
    """Draw the edge of a slice through a solid, given by `pixels` that are NaN outside the solid; `extent` in
    metres."""
    # Pad by one pixel, so that the edge is closed where it touches the border of the picture.
    is_inside = np.pad(np.isfinite(pixels).astype(float), 1)
    pixel_width, pixel_height = (extent[1] - extent[0]) / pixels.shape[1], (extent[3] - extent[2]) / pixels.shape[0]
    padded_extent = (
        extent[0] - pixel_width,
        extent[1] + pixel_width,
        extent[2] - pixel_height,
        extent[3] + pixel_height,
    )
    ax.contour(is_inside, [0.5], extent=padded_extent, origin="upper", colors=DARK_GREY, linewidths=0.9, zorder=2)


def slice_text(mesh: Mesh, height: float | None = None, beginning: str = "slice") -> str:
    """Text for a slice at z = `height` metres (default: half the height), such as "slice at z = 20.0 mm"; empty for a
    plane mesh."""
    if mesh.dimension == 2:
        return ""
    z = np.asarray(mesh.points)[:, 2]
    return f"{beginning} at z = {1e3 * ((z.min() + z.max()) / 2 if height is None else height):.1f} mm"


def plot_image(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | None = None,
    *,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE_SCALE,
    title: str | None = None,
    height: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw values per cell or per node of a mesh in colours.

    **Arguments:**

    - `mesh`: a plane mesh, or a solid, of which a slice is drawn.
    - `values`: values to draw, per cell (m,) or, interpolated, per node (n,).
    - `electrodes`: electrodes, which are drawn to scale and numbered.
    - `inclusions`: inclusions, which are marked by their sign and a circle.
    - `scale`: colour scale; default: for changes of conductivity in S (3-D: S/m). For conductivity itself, use
      `ColourScale(difference=False)`.
    - `height`: z in metres of the slice through a 3-D mesh; default: half the height.
    - `title`: title of the plot.
    - `ax`: axes to draw in; default: new axes.

    Raises `ValueError` for values that have a wrong shape, are complex or not finite, for a height outside the mesh,
    and for arguments of a wrong type.

    **Example:**

    ```python
    plot_image(mesh, image, electrodes, title="change of conductivity")
    ```
    """
    check_body(mesh, electrodes)
    check_scale(scale)
    value_array = np.asarray(values)
    if value_array.shape not in ((mesh.num_cells,), (mesh.num_points,)):
        raise ValueError(
            f"values has shape {value_array.shape}; give one for each of the {mesh.num_cells} cells or the "
            f"{mesh.num_points} nodes."
        )
    if np.iscomplexobj(value_array):
        raise ValueError("values are complex; draw their real or imaginary part.")
    ax = get_or_create_axes(ax)
    if mesh.dimension == 3:
        cell_image = (
            value_array if value_array.shape == (mesh.num_cells,) else value_array[np.asarray(mesh.cells)].mean(axis=1)
        )
        raster = Raster.create(mesh, height=height)
        pixels, extent = np.asarray(raster.sample(jnp.asarray(cell_image))), raster.extent
        if not np.isfinite(pixels).any():
            raise ValueError(f"height: there is no mesh at z = {height} m to cut through.")
        fitted_scale = scale.of(pixels[np.isfinite(pixels)], "S/m")
        mappable = ax.imshow(
            fitted_scale.factor * pixels, extent=extent, interpolation="nearest", **fitted_scale.keywords
        )
        draw_slice_outline(pixels, extent, ax)
    else:
        points = np.asarray(mesh.points)
        extent = extent_of(points)
        triangles = Triangulation(points[:, 0], points[:, 1], np.asarray(mesh.cells))
        fitted_scale = scale.of(value_array, "S")
        # Edges in the colour of their cell prevent gaps between cells, through which the background would be visible.
        flat_style = {"shading": "flat", "edgecolors": "face", "linewidth": 0.5}
        shading_style = flat_style if value_array.shape == (mesh.num_cells,) else {"shading": "gouraud"}
        mappable = ax.tripcolor(triangles, fitted_scale.factor * value_array, **shading_style, **fitted_scale.keywords)
    _finish_axes(ax, mesh, electrodes, inclusions, extent, title)
    fitted_scale.draw_bar(ax, mappable)
    return ax


def plot_raster(
    raster: ArrayLike,
    extent: tuple[float, float, float, float],
    *,
    mesh: Mesh | None = None,
    electrodes: AbstractElectrodes | None = None,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE_SCALE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a raster (rows, columns), row 0 at the top, with NaN pixels left blank; other arguments as in `plot_image`.

    `extent`: (x_min, x_max, y_min, y_max) in metres. `mesh`: the mesh of the raster, for its outline and the
    `electrodes`. Raises `ValueError` for a raster without finite values, for electrodes without a mesh, and for
    arguments of a wrong type.
    """
    check_scale(scale)
    if mesh is not None:
        check_body(mesh, electrodes)
    pixels = np.asarray(raster)
    finite_values = pixels[np.isfinite(pixels)]
    if pixels.ndim != 2 or finite_values.size == 0:
        raise ValueError(f"raster has shape {pixels.shape}; give (rows, columns) with at least one finite value.")
    if electrodes is not None and mesh is None:
        raise ValueError("electrodes are drawn along the boundary of a mesh: give mesh, the one the raster is of.")
    fitted_scale = scale.of(finite_values, "S")
    ax = get_or_create_axes(ax)
    mappable = ax.imshow(fitted_scale.factor * pixels, extent=extent, interpolation="nearest", **fitted_scale.keywords)
    _finish_axes(ax, mesh, electrodes, inclusions, extent, title)
    fitted_scale.draw_bar(ax, mappable)
    return ax


def _finish_axes(ax: Axes, mesh: Mesh | None, electrodes, inclusions, axes_extent, title: str | None) -> None:
    if mesh is not None and mesh.dimension == 2:
        draw_outline(mesh, ax)
    if mesh is not None and electrodes is not None:
        draw_electrodes(mesh, electrodes, ax=ax)
    draw_inclusions(inclusions, ax=ax)
    hide_axes(ax, axes_extent, numbered=electrodes is not None)
    draw_scale_bar(ax, axes_extent)
    if title:
        ax.set_title(title)


def plot_admittivity(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | None = None,
    *,
    difference: bool = True,
    limits: tuple[float | None, float | None] = (None, None),
    titles: tuple[str, str] = ("Conductivity σ", "Susceptivity ωε"),
    figure: Figure | None = None,
    **options: Any,
) -> tuple[Axes, Axes]:
    """Draw conductivity σ and susceptivity ωε of a complex admittivity σ + iωε side by side in one figure.

    **Arguments:**

    - `mesh`, `electrodes`, `options`: as for `plot_image`.
    - `values` (m,) or (n,): admittivity, S (3-D: S/m).
    - `difference`: whether values are changes, with colours centred at zero.
    - `limits`: values at the ends of the two colour bars; default: the maximum magnitude of each part, so that a much
      smaller part is visible, too.
    - `titles`: titles of the two plots.
    - `figure`: the figure to draw in; default: a new one.

    Raises `ValueError` for values that are not complex, and in the same cases as `plot_image`.

    **Example:**

    ```python
    plot_admittivity(mesh, image * (1 + 0.1j), electrodes)
    ```
    """
    complex_values: Any = np.asarray(values)
    if not np.iscomplexobj(complex_values):
        raise ValueError("values are real; draw them with plot_image.")
    if figure is None:
        figure = Figure(figsize=(11.5, 5), layout="constrained")
    title_prefix = "Change of " if difference else ""
    component_names = [f"{title_prefix}{name}" for name in ("conductivity σ", "susceptivity ωε")]
    first_component, second_component = (
        plot_image(
            mesh,
            component_values,
            electrodes,
            scale=ColourScale(difference=difference, quantity=name[0].upper() + name[1:], limit=colour_limit),
            title=component_title,
            ax=ax,
            **options,
        )
        for ax, component_values, name, colour_limit, component_title in zip(
            figure.subplots(1, 2),
            (complex_values.real, complex_values.imag),
            component_names,
            limits,
            titles,
            strict=True,
        )
    )
    return first_component, second_component


def plot_sensitivity(
    model: ForwardModel, conductivity, *, title: str | None = None, height: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the sensitivity ‖∂v/∂σ_e‖ / |e| of every cell e, with the norm over all channels, in decibels relative to
    the value exceeded in 1 % of the cells.

    The division by the area (3-D: volume) |e| makes the sensitivity independent of the mesh. `conductivity`: as in
    `model.voltages`, scalar or per cell, in S (3-D: S/m); `height` as in `plot_image`. Raises `ValueError` for a
    conductivity per node.
    """
    jacobian_matrix = np.asarray(model.jacobian(conductivity))
    if jacobian_matrix.shape[1] != model.mesh.num_cells:
        raise ValueError("conductivity: give a scalar or one value per cell, for a sensitivity per cell.")
    sensitivity_density = np.linalg.norm(jacobian_matrix, axis=0) / np.asarray(measures(model.mesh))
    sensitivity_decibels = 20 * np.log10(np.maximum(sensitivity_density / sensitivity_density.max(), 1e-12))
    # The field is singular at the ends of electrodes, so 0 dB is set to the value exceeded in 1 % of the cells.
    upper_limit = np.quantile(sensitivity_decibels, 0.99)
    quantity_label = "Sensitivity per area (dB)" if model.mesh.dimension == 2 else "Sensitivity per volume (dB)"
    return plot_image(
        model.mesh,
        np.minimum(sensitivity_decibels, upper_limit) - upper_limit,
        model.electrodes,
        scale=ColourScale(difference=False, quantity=quantity_label, unit="", limit=0.0, colour_map="magma"),
        title=title,
        height=height,
        ax=ax,
    )
