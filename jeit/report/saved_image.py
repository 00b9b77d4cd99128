"""Read saved images, and draw them in other views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Inexact

from jeit.arguments import counted, describe
from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrode_shapes import ElectrodeShapes, shapes_of
from jeit.files import npz_arrays, require_arrays
from jeit.image import Inclusion, Plane, SolidForm
from jeit.mesh import Mesh
from jeit.mesh.checks import size_checked
from jeit.report.folder import results

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jeit.plot import Camera, ColourScale

_VALID_FILE_HINT = "give the image.npz that jeit reconstruct writes"
# Suffixes of the names of files that are not images, by a description of the kind of file.
_SUFFIXES_OF_OTHER_FILES = {
    "a table of data, which is to be imaged first": (".csv", ".txt", ".mat", ".eit", ".get", ".npy"),
    "a picture, which any viewer shows": (".png", ".gif", ".mp4", ".jpg", ".jpeg", ".svg", ".pdf"),
    "a file for ParaView": (".vtu", ".vtk", ".xdmf", ".pvd"),
    "a mesh": (".msh", ".stl", ".obj", ".step", ".stp"),
    "a description": (".toml",),
    "a report": (".json", ".html"),
}
_REQUIRED_ARRAYS = ("conductivity", "points", "cells")
_READ_ARRAYS = (
    *_REQUIRED_ARRAYS,
    "background",
    "departure",
    "electrode_corners",
    "electrode_sizes",
    "electrode_numbers",
    "inclusion_centroids",
    "inclusion_sizes",
    "inclusion_peaks",
    "inclusion_centres",
    "inclusion_axes",
    "inclusion_columns",
)


@dataclass(frozen=True)
class SavedImage:
    """Content of an `image.npz`: a body and its image.

    **Fields**

    - `mesh`: the mesh of the body.
    - `change`: change of conductivity in every cell (m,), S/m (2-D: S); complex for admittivity.
    - `background`: conductivity of the body in the reference frame; None if the file lacks it.
    - `departure`: (m,), for iterative images, logarithm to base 10 of conductivity divided by background; else None.
    - `electrodes`: electrodes as polygons; None if the file has none.
    - `inclusions`: the inclusions found in the image.

    **Example:**

    ```python
    write_image(imaged, "out")
    saved = read_image("out/image.npz")
    saved.mesh, saved.change
    ```
    """

    mesh: Mesh
    change: Inexact[np.ndarray, " m"]
    background: complex | float | None = None
    departure: Float[np.ndarray, " m"] | None = None
    electrodes: ElectrodeShapes | None = None
    inclusions: tuple[Inclusion, ...] = ()

    @property
    def unit(self) -> str:
        """Unit of conductivity."""
        return "S" if self.mesh.dimension == 2 else "S/m"


def saved_extras(
    mesh: Mesh, electrodes: AbstractElectrodes, inclusions: tuple[Inclusion, ...]
) -> dict[str, np.ndarray]:
    """Arrays of an `image.npz` for electrodes and inclusions.

    - `electrode_corners`: (q, d), corners of the polygons of all electrodes; `electrode_sizes`: (p,), number of corners
      of each polygon; `electrode_numbers`: (p,), electrode of each polygon, from 0.
    - `inclusion_centroids`: (i, d) in metres; `inclusion_sizes`: (i,), area in m² (3-D: volume in m³);
      `inclusion_peaks`: (i,), change of conductivity.
    - For bodies fitted in a solid, `inclusion_centres`: (i, 3); `inclusion_axes`: (i, 3, 3), half axes;
      `inclusion_columns`: (i,), whether the body is a column.
    """
    shapes, dimension = shapes_of(mesh, electrodes), np.shape(mesh.points)[1]
    extras = {
        "electrode_corners": shapes.corners,
        "electrode_sizes": shapes.sizes,
        "electrode_numbers": shapes.electrode,
        "inclusion_centroids": np.array([inclusion.centroid for inclusion in inclusions]).reshape(-1, dimension),
        "inclusion_sizes": np.array([inclusion.area for inclusion in inclusions], float),
        "inclusion_peaks": np.array([inclusion.peak for inclusion in inclusions], float),
    }
    solid_forms = [inclusion.form for inclusion in inclusions if inclusion.form is not None]
    if solid_forms and len(solid_forms) == len(inclusions):
        extras |= {
            "inclusion_centres": np.array([form.centre for form in solid_forms]),
            "inclusion_axes": np.array([form.axes for form in solid_forms]),
            "inclusion_columns": np.array([form.column for form in solid_forms]),
        }
    return extras


def read_image(path: str | Path) -> SavedImage:
    """Read an `image.npz` written by `jeit reconstruct` or `write_image`.

    Files of earlier versions lack electrodes and inclusions. Raises `ValueError` for files that are not saved images
    and for arrays that do not fit together, and `OSError` if the file does not exist.

    **Arguments:**

    - `path`: the file.

    **Example:**

    ```python
    write_image(imaged, "out")
    saved = read_image("out/image.npz")
    ```
    """
    path = Path(path)
    file_name = path.name[:80]
    if path.is_dir():
        raise ValueError(f"{file_name} is a folder; give the image.npz in it.")
    try:
        with path.open("rb") as file:
            if file.read(2) != b"PK":
                raise ValueError(f"not an image that jeit wrote{_other_file_hint(path)}; {_VALID_FILE_HINT}.")
        arrays = npz_arrays(path, *_READ_ARRAYS)
        _check_contains_image(arrays)
        require_arrays(arrays, *_REQUIRED_ARRAYS)
        if arrays["points"].dtype.kind not in "fiu":
            raise ValueError(f"'points' is {describe(arrays['points'])}; real numbers are wanted, metres.")
        with size_checked():  # the size of the mesh was checked by the command that wrote the file
            mesh = Mesh.create(arrays["points"], arrays["cells"])
        return _create_saved_image(mesh, arrays)
    except ValueError as error:
        raise ValueError(f"{file_name}: {error}"[:400]) from None


def _check_contains_image(arrays: dict[str, np.ndarray]) -> None:
    """Raise `ValueError` for NPZ files that do not contain one image: files of a series of frames, and files without an
    image."""
    array_names = set(arrays[""].tolist())
    if array_names & {"images", "depth", "functional"}:
        raise ValueError("it holds many frames; give the image.npz of one, of jeit reconstruct.")
    if not array_names & {*_REQUIRED_ARRAYS}:
        first_names = ", ".join(name[:40] for name in sorted(array_names)[:6])
        raise ValueError(f"it holds {first_names or 'nothing'}, and no image; {_VALID_FILE_HINT}.")


def _other_file_hint(path: Path) -> str:
    file_kind = next(
        (file_kind for file_kind, suffixes in _SUFFIXES_OF_OTHER_FILES.items() if path.suffix.lower() in suffixes), None
    )
    return "" if file_kind is None else f", but {file_kind}"


def _create_saved_image(mesh: Mesh, arrays: dict[str, np.ndarray]) -> SavedImage:
    def per_cell(name: str, dtype_kinds: str) -> np.ndarray | None:
        if name not in arrays:
            return None
        values = arrays[name]
        if values.shape != (mesh.num_cells,) or values.dtype.kind not in dtype_kinds:
            raise ValueError(f"'{name}' is {describe(values)}; there are {counted(mesh.num_cells, 'cell')}.")
        if not np.isfinite(values).all():
            raise ValueError(f"'{name}' has values that are not finite.")
        return values

    change = per_cell("conductivity", "fiuc")
    assert change is not None
    background = arrays.get("background")
    if background is not None and (background.shape != () or background.dtype.kind not in "fiuc"):
        raise ValueError(f"'background' is {describe(background)}; one number is wanted.")
    return SavedImage(
        mesh=mesh,
        change=change,
        background=None if background is None else background.item(),
        departure=per_cell("departure", "f"),
        electrodes=_read_electrodes(mesh, arrays),
        inclusions=_read_inclusions(mesh, arrays),
    )


def _read_electrodes(mesh: Mesh, arrays: dict[str, np.ndarray]) -> ElectrodeShapes | None:
    if "electrode_corners" not in arrays:
        return None
    require_arrays(arrays, "electrode_sizes", "electrode_numbers")
    polygon_corners, corner_counts, electrode_numbers = (
        arrays[f"electrode_{name}"] for name in ("corners", "sizes", "numbers")
    )
    if (
        polygon_corners.ndim != 2
        or polygon_corners.shape[1] != mesh.points.shape[1]
        or polygon_corners.dtype.kind not in "fiu"
    ):
        raise ValueError("'electrode_corners' are no places in the mesh's space; write it again.")
    if not np.isfinite(polygon_corners).all():
        raise ValueError("'electrode_corners' are no places: some are not finite; write it again.")
    are_integers = all(array.dtype.kind in "iu" and array.ndim == 1 for array in (corner_counts, electrode_numbers))
    if not (
        are_integers
        and len(corner_counts) == len(electrode_numbers) > 0
        and corner_counts.min() > 0
        and corner_counts.sum() == len(polygon_corners)
    ):
        raise ValueError("'electrode_sizes' does not say whose corners 'electrode_corners' are; write it again.")
    # Every electrode needs a polygon, because the polygon states the position of the electrode.
    if not np.array_equal(np.unique(electrode_numbers), np.arange(electrode_numbers.max() + 1)):
        raise ValueError("'electrode_numbers' leave electrodes out; write it again.")
    return ElectrodeShapes(polygon_corners.astype(float), corner_counts, electrode_numbers)


def _read_inclusions(mesh: Mesh, arrays: dict[str, np.ndarray]) -> tuple[Inclusion, ...]:
    if "inclusion_centroids" not in arrays:
        return ()
    require_arrays(arrays, "inclusion_sizes", "inclusion_peaks")
    centroids, inclusion_sizes, peaks = (arrays[f"inclusion_{name}"] for name in ("centroids", "sizes", "peaks"))
    num_inclusions = peaks.size
    if centroids.shape != (num_inclusions, mesh.points.shape[1]) or not inclusion_sizes.shape == peaks.shape == (
        num_inclusions,
    ):
        raise ValueError("'inclusion_centroids', '_sizes' and '_peaks' do not belong together; write it again.")
    if not all(array.dtype.kind == "f" and np.isfinite(array).all() for array in (centroids, inclusion_sizes, peaks)):
        raise ValueError("inclusions have values that are not finite; write it again.")
    inclusion_values = zip(
        centroids.tolist(),
        inclusion_sizes.tolist(),
        peaks.tolist(),
        _read_solid_forms(arrays, num_inclusions),
        strict=True,
    )
    return tuple(
        Inclusion(1 if peak > 0 else -1, tuple(centroid), size, peak, mesh.is_surface, form)
        for centroid, size, peak, form in inclusion_values
    )


def _read_solid_forms(arrays: dict[str, np.ndarray], num_inclusions: int) -> list[SolidForm | None]:
    if "inclusion_axes" not in arrays:
        return [None] * num_inclusions
    require_arrays(arrays, "inclusion_centres", "inclusion_columns")
    centres, half_axes, column_flags = (arrays[f"inclusion_{name}"] for name in ("centres", "axes", "columns"))
    if not (
        centres.shape == (num_inclusions, 3)
        and half_axes.shape == (num_inclusions, 3, 3)
        and column_flags.shape == (num_inclusions,)
    ):
        raise ValueError("'inclusion_centres', '_axes' and '_columns' are not of every inclusion; write it again.")
    if not all(array.dtype.kind == "f" and np.isfinite(array).all() for array in (centres, half_axes)):
        raise ValueError("inclusions have places that are not finite; write it again.")
    return [
        SolidForm(tuple(centre), tuple(map(tuple, axes_of_body)), bool(is_column))
        for centre, axes_of_body, is_column in zip(
            centres.tolist(), half_axes.tolist(), column_flags.tolist(), strict=True
        )
    ]


VIEW_FILES = ("overview.png", "isosurfaces.png", "slices.png", "planes.png", "surface.png", "image.png")
"""Names of the files written by `write_views`: the first three for a solid, `planes.png` if planes are given,
`surface.png` for a surface in space, and `image.png` for a sheet."""
# Default levels of isosurfaces, as fractions of the maximum change, and resolution of pictures in dots per inch.
_DEFAULT_ISOSURFACE_LEVELS, _PICTURE_DPI = (0.5,), 150


def write_views(
    image: SavedImage,
    folder: str | Path,
    *,
    camera: "Camera | None" = None,
    levels: Sequence[float] = _DEFAULT_ISOSURFACE_LEVELS,
    planes: Sequence[Plane] = (),
    axis: str = "z",
    slices: int = 9,
) -> tuple[str, ...]:
    """Write pictures of an image to a folder, and return their names.

    - For a solid: `overview.png`; `isosurfaces.png`, isosurfaces, seen from the `camera`, from the opposite side, from
      the front and from above; `slices.png`, evenly spaced slices; and `planes.png`, sections by the `planes`, if there
      are any.
    - For a surface in space: `surface.png`, seen from the same sides.
    - For a sheet: `image.png`.

    For complex images, the real part is drawn. Raises `ValueError` if there are `planes` for a body that is not a
    solid, for a path that cannot be a folder, and in the same cases as `jeit.plot.plot_solid`.

    **Arguments:**

    - `image`: the image.
    - `folder`: folder of the files, created if needed.
    - `camera`: direction of view.
    - `levels`: isosurfaces, as in `jeit.plot.plot_isosurfaces`.
    - `planes`: planes of sections.
    - `axis`, `slices`: axis perpendicular to the slices, "x", "y" or "z", and number of slices.

    **Example:**

    ```python
    write_image(imaged, "out")
    write_views(read_image("out/image.npz"), "out")
    ```
    """
    if image.mesh.dimension != 3 and planes:
        raise ValueError("planes cut solids; this image is of a sheet. Leave them out.")
    figures_by_name = _draw_figures(image, camera, levels, planes, axis, slices)
    with results(folder, tuple(figures_by_name)) as temporary_folder:
        for name, figure in figures_by_name.items():
            figure.savefig(temporary_folder / name, dpi=_PICTURE_DPI)
    return tuple(figures_by_name)


def drawn_values(image: SavedImage) -> tuple[np.ndarray, "ColourScale"]:
    """Values per cell to draw, and their colour scale: `departure` for iterative images, the real part of the change
    for complex images, otherwise the change of conductivity."""
    from jeit.plot.colours import CHANGE_SCALE, FACTOR_SCALE, ColourScale

    if image.departure is not None:
        return image.departure, FACTOR_SCALE
    if np.iscomplexobj(image.change):
        return np.real(image.change), ColourScale(quantity="Change of conductivity σ")
    return np.asarray(image.change), CHANGE_SCALE


def _draw_figures(image: SavedImage, camera, levels, planes, axis: str, slices: int) -> dict[str, "Figure"]:
    from jeit.plot.solid.isosurfaces import plot_isosurfaces
    from jeit.plot.solid.scene import CORNER_VIEW, Camera
    from jeit.plot.solid.slices import plot_slice, plot_slices, plot_solid
    from jeit.plot.solid.surfaces import plot_surface

    main_camera = CORNER_VIEW if camera is None else camera
    values, scale = drawn_values(image)
    mesh, electrodes = image.mesh, image.electrodes
    if mesh.dimension == 2 and not mesh.is_surface:
        return {"image.png": _draw_sheet(image, values, scale)}
    opposite_camera = Camera(main_camera.azimuth + 180, main_camera.elevation)
    cameras_by_title = {
        "": main_camera,
        "from the other side": opposite_camera,
        "from the front": Camera(-90, 0),
        "from above": Camera(-90, 90),
    }

    def draw_panels(draw_subject, panel_subjects, width: float, height: float):
        figure = _new_figure(width, height)
        panels = figure.subplots(math.ceil(len(panel_subjects) / 2), min(2, len(panel_subjects)), squeeze=False).ravel()
        for subject, panel in zip(panel_subjects, panels, strict=False):
            draw_subject(subject, panel)
        for panel in panels[len(panel_subjects) :]:
            panel.set_axis_off()
        return figure

    if mesh.is_surface:

        def draw_surface_side(name, panel):
            cells = np.asarray(mesh.cells)
            plot_surface(
                mesh.points, cells, values, electrodes, camera=cameras_by_title[name], scale=scale, title=name, ax=panel
            )

        return {"surface.png": draw_panels(draw_surface_side, list(cameras_by_title), 11, 9.5)}

    plot_options: dict[str, Any] = {"inclusions": image.inclusions, "scale": scale}

    def draw_isosurface_side(name, panel):
        plot_isosurfaces(
            mesh, values, electrodes, levels=levels, camera=cameras_by_title[name], ax=panel, **plot_options
        )
        panel.set_title(name or _camera_angle_text(main_camera), fontsize=10)

    # Sections are drawn first, because they are fast, and because drawing them raises an error for planes that miss the
    # body and for axes that do not exist.
    section_figures = {}
    if planes:

        def draw_section(plane, panel):
            plot_slice(mesh, values, plane, electrodes, ax=panel, **plot_options)

        num_rows = math.ceil(len(planes) / 2)
        section_figures["planes.png"] = draw_panels(draw_section, list(planes), 5.6 * min(2, len(planes)), 5 * num_rows)
    section_figures = {
        "slices.png": plot_slices(mesh, values, electrodes, axis=axis, at=slices, **plot_options),
        **section_figures,
    }
    return {
        "overview.png": plot_solid(mesh, values, electrodes, levels=levels, camera=main_camera, **plot_options),
        "isosurfaces.png": draw_panels(draw_isosurface_side, list(cameras_by_title), 12, 10),
        **section_figures,
    }


def _camera_angle_text(camera: "Camera") -> str:
    return f"azimuth {camera.azimuth:g}°, elevation {camera.elevation:g}°".replace("-", "−")


def _new_figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _draw_sheet(image: SavedImage, values, scale) -> "Figure":
    from jeit.plot.axes import extent_of, hide_axes
    from jeit.plot.imaging.electrodes import draw_shapes
    from jeit.plot.imaging.image import plot_image

    figure = _new_figure(6.4, 5.6)
    ax = plot_image(image.mesh, values, inclusions=image.inclusions, scale=scale, ax=figure.subplots())
    if image.electrodes is not None:
        draw_shapes(image.mesh, image.electrodes, ax=ax)
        hide_axes(ax, extent_of(np.asarray(image.mesh.points)))
    return figure
