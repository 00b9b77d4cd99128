"""Interactive views of solid images, which can be rotated and cut with the mouse; needs PyVista."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from jeit.arguments.extras import import_optional, installation_command
from jeit.electrodes import AbstractElectrodes, ElectrodeShapes, shapes_of
from jeit.image import Inclusion
from jeit.mesh import Mesh
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, ColourScale
from jeit.plot.imaging.electrodes import ELECTRODE_COLOUR
from jeit.plot.solid.isosurfaces import DEFAULT_LEVELS, OUTER_OPACITY, check_drawn, level_surfaces
from jeit.plot.solid.scene import BODY_COLOUR
from jeit.plot.solid.slices import cell_values

if TYPE_CHECKING:
    import pyvista  # pyright: ignore[reportMissingImports]

_WINDOW_SIZE_IN_PIXELS = (1280, 860)


def view_solid(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | ElectrodeShapes | None = None,
    *,
    levels: Sequence[float] = DEFAULT_LEVELS,
    inclusions: Sequence[Inclusion] = (),
    scale: ColourScale = CHANGE_SCALE,
    off_screen: bool = False,
) -> pyvista.Plotter:
    """Create an interactive view of a solid image (extra `view`): hull, isosurfaces, numbered electrodes, a slice that
    can be dragged through the body, and a colour bar. Lengths are in millimetres.

    Call `show()` of the returned plotter, or, if created with `off_screen`, `screenshot("view.png")`.

    **Arguments:**

    - `mesh`, `values`, `electrodes`, `levels`, `inclusions`, `scale`: as for `plot_isosurfaces`.
    - `off_screen`: whether to draw without a window.

    Raises `ImportError` if PyVista is not installed, and `ValueError` in the same cases as `plot_isosurfaces`.

    **Example:**

    ```python
    plotter = view_solid(solid, solid_image, off_screen=True)  # with pyvista
    ```
    """
    check_drawn(mesh, electrodes, scale)
    isosurfaces = level_surfaces(mesh, values, levels, is_signed=scale.difference)
    pv: Any = import_optional("pyvista", "the interactive view", "Pictures without it: jeit.plot.plot_solid.")
    fitted_scale = scale.of(np.asarray(values), "S/m")
    colour_options: dict[str, Any] = {
        "cmap": fitted_scale.keywords["cmap"],
        "clim": (fitted_scale.keywords["vmin"], fitted_scale.keywords["vmax"]),
    }
    points = 1e3 * np.asarray(mesh.points)
    plotter = pv.Plotter(off_screen=off_screen, window_size=list(_WINDOW_SIZE_IN_PIXELS))
    if not off_screen:
        # Depth peeling sorts translucent surfaces; without a graphics card, depth peeling would make these surfaces
        # disappear.
        plotter.enable_depth_peeling()
    surface_mesh = pv.PolyData.from_regular_faces(points, np.asarray(mesh.facets))
    plotter.add_mesh(surface_mesh, color=BODY_COLOUR, opacity=0.12, name="hull")
    plotter.add_mesh(surface_mesh.extract_feature_edges(30), color=DARK_GREY, line_width=1.5, name="edges")
    for k, (isosurface_value, isosurface_level, isosurface) in enumerate(isosurfaces):
        if not len(isosurface.triangles):
            continue
        body_shell = pv.PolyData.from_regular_faces(1e3 * isosurface.points, isosurface.triangles)
        body_shell["value"] = np.full(body_shell.n_points, fitted_scale.factor * isosurface_value)
        isosurface_opacity = 1.0 if isosurface_level == max(levels) else OUTER_OPACITY
        mesh_options = {"smooth_shading": True, "show_scalar_bar": False, "name": f"isosurface {k}"}
        plotter.add_mesh(body_shell, scalars="value", opacity=isosurface_opacity, **mesh_options, **colour_options)
    volume_grid = pv.UnstructuredGrid({pv.CellType.TETRA: np.asarray(mesh.cells)}, points)
    volume_grid.cell_data["value"] = fitted_scale.factor * cell_values(mesh, values)
    # The label has two lines, since VTK cuts off text that is wider than the bar.
    quantity_name, unit_text, unit_name = fitted_scale.label.rpartition(" (")
    bar_options = {
        "title": f"{quantity_name}\n{unit_text.strip()}{unit_name}",
        "color": DARK_GREY,
        "vertical": True,
        "n_labels": 5,
        "fmt": "%.3g",
    }
    bar_options |= {"title_font_size": 16, "label_font_size": 14, "position_x": 0.86, "position_y": 0.25, "height": 0.5}
    plotter.add_mesh_slice(
        volume_grid, normal="z", scalars="value", scalar_bar_args=bar_options, name="plane", **colour_options
    )
    if electrodes is not None:
        electrode_shapes = shapes_of(mesh, electrodes) if isinstance(electrodes, AbstractElectrodes) else electrodes
        _add_electrodes(plotter, pv, electrode_shapes)
    for k, inclusion in enumerate(inclusions):
        if inclusion.form is None:
            body_surface = pv.Sphere(radius=1e3 * inclusion.radius, center=1e3 * np.array(inclusion.centroid))
        else:
            isosurface = inclusion.form.surface()
            body_surface = pv.PolyData.from_regular_faces(1e3 * isosurface.points, isosurface.triangles)
        plotter.add_mesh(body_surface, style="wireframe", color=DARK_GREY, opacity=0.15, name=f"inclusion {k}")
    plotter.add_axes()  # pyright: ignore[reportCallIssue]
    plotter.camera_position = [(-1, -1.7, 1), (0, 0, 0), (0, 0, 1)]
    plotter.reset_camera()  # pyright: ignore[reportCallIssue]
    return plotter


def can_view() -> str:
    """Reason why an interactive view cannot be opened on this machine; empty if it can."""
    if find_spec("pyvista") is None:
        return f"PyVista is not installed: {installation_command('view')}"
    if sys.platform in ("darwin", "win32") or os.environ.get("WAYLAND_DISPLAY"):
        return ""
    if not (display_name := os.environ.get("DISPLAY", "")):
        return "there is no display"
    return "" if _display_responds(display_name) else f"nothing answers at DISPLAY={display_name[:40]}"


def _display_responds(display_name: str) -> bool:
    """Whether an X server listens at a display of this machine; displays of other machines, and texts that do not name
    a display, are not checked and yield True."""
    display_host, _, display_number = display_name.rpartition(":")
    server_number = display_number.partition(".")[0]
    if display_host not in ("", "unix", "localhost") or not server_number.isdecimal() or len(server_number) > 4:
        return True
    # Standard addresses of X11 servers (Xtrans). PyVista's own check calls a program that may not be installed.
    path = f"/tmp/.X11-unix/X{server_number}"
    local_addresses = [(socket.AF_UNIX, path), (socket.AF_UNIX, "\0" + path)]
    for socket_family, display_address in (
        [(socket.AF_INET, (display_host, 6000 + int(server_number)))]
        if display_host == "localhost"
        else local_addresses
    ):
        with socket.socket(socket_family, socket.SOCK_STREAM) as connection, suppress(OSError):
            connection.settimeout(1)
            connection.connect(display_address)
            return True
    return False


def _add_electrodes(plotter: pyvista.Plotter, pv: Any, electrode_shapes: ElectrodeShapes) -> None:
    """Add electrodes to the plotter as polygons in the colour of metal, or as balls if they are points, with their
    numbers."""
    largest_extent = 1e3 * float(np.ptp(electrode_shapes.corners, axis=0).max())
    electrode_surfaces = []
    for polygon_corners in electrode_shapes.polygons():
        if len(polygon_corners) == 1:
            electrode_surfaces.append(pv.Sphere(radius=0.012 * largest_extent, center=1e3 * polygon_corners[0]))
        else:
            # Triangles around the centre, since a patch on a curved wall is not a plane polygon.
            ring_indices = np.arange(len(polygon_corners))
            fan_triangles = np.stack(
                [ring_indices, np.roll(ring_indices, -1), np.full(len(ring_indices), len(ring_indices))], axis=1
            )
            electrode_surfaces.append(
                pv.PolyData.from_regular_faces(
                    1e3 * np.vstack([polygon_corners, polygon_corners.mean(axis=0)]), fan_triangles
                )
            )
    plotter.add_mesh(pv.merge(electrode_surfaces), color=ELECTRODE_COLOUR, name="electrodes", ambient=0.35)
    electrode_numbers = [str(k + 1) for k in range(electrode_shapes.number)]
    label_style: dict[str, Any] = {"font_size": 14, "text_color": DARK_GREY, "shape_opacity": 0.6, "show_points": False}
    plotter.add_point_labels(
        1e3 * electrode_shapes.middles(), electrode_numbers, always_visible=True, shape_color="white", **label_style
    )
