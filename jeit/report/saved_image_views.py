"""Pictures of an image on disk: of a solid from several sides and cut in slices, of a surface from several sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jeit.image import Plane
from jeit.report.folder import results
from jeit.report.saved_image import SavedImage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jeit.plot import Camera, ColourScale

VIEW_FILES = ("overview.png", "isosurfaces.png", "slices.png", "planes.png", "surface.png", "image.png")
"""What `write_views` may write: the first three of a solid, planes if any are asked for, the last two of a surface in
space and of a sheet."""
_HALF, _DPI = (0.5,), 150


def write_views(
    image: SavedImage,
    folder: str | Path,
    *,
    camera: "Camera | None" = None,
    levels: Sequence[float] = _HALF,
    planes: Sequence[Plane] = (),
    axis: str = "z",
    slices: int = 9,
) -> tuple[str, ...]:
    """Write pictures of an image into `folder`, made if need be, and return their names.

    Of a solid: `overview.png`, `isosurfaces.png` at `levels` from the `camera`, from its other side, from the front
    and from above, `slices.png`, so many across `axis`, and `planes.png` if `planes` are given. Of a surface in space:
    `surface.png`, from the same sides. Of a sheet: `image.png`. Complex images are drawn by their real part. Raises
    `ValueError` for planes through what is no solid, for what cannot be a folder, and as `jeit.plot.plot_solid`.
    """
    if image.mesh.dimension != 3 and planes:
        raise ValueError("planes cut solids; this image is of a sheet. Leave them out.")
    drawn = _figures(image, camera, levels, planes, axis, slices)
    with results(folder, tuple(drawn)) as made:
        for name, figure in drawn.items():
            figure.savefig(made / name, dpi=_DPI)
    return tuple(drawn)


def drawn_values(image: SavedImage) -> tuple[np.ndarray, "ColourScale"]:
    """What is drawn of an image, per cell, and its scale: the departure of iterative ones, real parts of complex."""
    from jeit.plot.colour_scale import CHANGE, ColourScale
    from jeit.plot.solid.overview import LOGARITHM

    if image.departure is not None:
        return image.departure, LOGARITHM
    if np.iscomplexobj(image.change):
        return np.real(image.change), ColourScale(quantity="Change of conductivity σ")
    return np.asarray(image.change), CHANGE


def _figures(image: SavedImage, camera, levels, planes, axis: str, slices: int) -> dict[str, "Figure"]:
    from jeit.plot.solid.camera import FROM_THE_CORNER, Camera
    from jeit.plot.solid.isosurfaces import plot_isosurfaces
    from jeit.plot.solid.overview import plot_solid
    from jeit.plot.solid.shaded_surface import plot_surface
    from jeit.plot.solid.slices import plot_slice, plot_slices

    first = FROM_THE_CORNER if camera is None else camera
    values, scale = drawn_values(image)
    mesh, electrodes = image.mesh, image.electrodes
    if mesh.dimension == 2 and not mesh.is_surface:
        return {"image.png": _sheet(image, values, scale)}
    other = Camera(first.azimuth + 180, first.elevation)
    sides = {"": first, "from the other side": other, "from the front": Camera(-90, 0), "from above": Camera(-90, 90)}

    def each(draw, names, width: float, height: float):
        figure = _figure(width, height)
        panels = figure.subplots(math.ceil(len(names) / 2), min(2, len(names)), squeeze=False).ravel()
        for name, panel in zip(names, panels, strict=False):
            draw(name, panel)
        for panel in panels[len(names) :]:
            panel.set_axis_off()
        return figure

    if mesh.is_surface:

        def side_of_surface(name, panel):
            cells = np.asarray(mesh.cells)
            plot_surface(mesh.points, cells, values, electrodes, camera=sides[name], scale=scale, title=name, ax=panel)

        return {"surface.png": each(side_of_surface, list(sides), 11, 9.5)}

    marked: dict[str, Any] = {"inclusions": image.inclusions, "scale": scale}

    def side(name, panel):
        plot_isosurfaces(mesh, values, electrodes, levels=levels, camera=sides[name], ax=panel, **marked)
        panel.set_title(name or _angles(first), fontsize=10)

    found = {
        "overview.png": plot_solid(mesh, values, electrodes, levels=levels, camera=first, **marked),
        "isosurfaces.png": each(side, list(sides), 12, 10),
        "slices.png": plot_slices(mesh, values, electrodes, axis=axis, at=slices, **marked),
    }
    if planes:

        def cut(plane, panel):
            plot_slice(mesh, values, plane, electrodes, ax=panel, **marked)

        rows = math.ceil(len(planes) / 2)
        found["planes.png"] = each(cut, list(planes), 5.6 * min(2, len(planes)), 5 * rows)
    return found


def _angles(camera: "Camera") -> str:
    return f"azimuth {camera.azimuth:g}°, elevation {camera.elevation:g}°".replace("-", "−")


def _figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _sheet(image: SavedImage, values, scale) -> "Figure":
    from jeit.plot.axes import bare, extent_of
    from jeit.plot.imaging.electrodes import draw_shapes
    from jeit.plot.imaging.image import plot_image

    figure = _figure(6.4, 5.6)
    ax = plot_image(image.mesh, values, inclusions=image.inclusions, scale=scale, ax=figure.subplots())
    if image.electrodes is not None:
        draw_shapes(image.mesh, image.electrodes, ax=ax)
        bare(ax, extent_of(np.asarray(image.mesh.points)))
    return figure
