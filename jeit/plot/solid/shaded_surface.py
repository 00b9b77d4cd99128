"""Shaded plots of triangulated surfaces in space with values on them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes.electrode_shapes import ElectrodeShapes
from jeit.plot.axes import CHANGE, ColourScale, FittedScale, axes_or_new, check_scale
from jeit.plot.solid.body import add_electrodes, number_electrodes
from jeit.plot.solid.scene import BODY, CORNER_VIEW, Camera, Scene, hide_axes_in_space


def plot_surface(
    points: ArrayLike,
    triangles: ArrayLike,
    values: ArrayLike | None = None,
    electrodes: ElectrodeShapes | None = None,
    *,
    camera: Camera = CORNER_VIEW,
    scale: ColourScale = CHANGE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a surface in space.

    **Arguments:**

    - `points` (n, 3): corners of the triangles, metres.
    - `triangles` (m, 3): indices of points.
    - `values`: one value per triangle or per point; without values, the surface is grey.
    - `electrodes`: from `jeit.electrodes.shapes_of`, drawn on the surface and numbered.
    - `camera`: direction of view.
    - `scale`: colour scale; default: for changes of sheet conductivity in S.
    - `title`: title of the plot.
    - `ax`: axes to draw in; default: new axes.

    Raises `ValueError` for arrays of other shapes, values that are not finite, and arguments of another type.

    **Example:**

    ```python
    from jeit.mesh import sphere
    ball = sphere(0.05, num_points=162)
    plot_surface(ball.points, ball.cells, ball.points[:, 2], scale=ColourScale(quantity="height", unit="m"))
    ```
    """
    point_array, triangle_array = checked_surface(points, triangles)
    check_kind("camera", camera, Camera, "a Camera, such as Camera(azimuth=-60, elevation=25)")
    check_scale(scale)
    if electrodes is not None:
        check_kind("electrodes", electrodes, ElectrodeShapes, "ElectrodeShapes, of shapes_of(mesh, electrodes)")
    ax = axes_or_new(ax)
    scene, fitted_scale = Scene(camera), None
    if values is None:
        colours = np.array(to_rgba(BODY))
    else:
        image = checked_values(values, len(point_array), len(triangle_array))
        fitted_scale = scale.of(image, "S")
        colours = colours_of(
            fitted_scale, image if len(image) == len(triangle_array) else image[triangle_array].mean(axis=1)
        )
    scene.add_triangles(point_array, triangle_array, colours, smooth=True)
    if electrodes is not None:
        add_electrodes(scene, point_array, triangle_array, electrodes)
    scene.draw(ax)
    hide_axes_in_space(ax, camera, point_array, numbered=electrodes is not None)
    if electrodes is not None:
        number_electrodes(ax, scene, point_array, triangle_array, electrodes, number_hidden=False)
    if title is not None:
        ax.set_title(title)
    if fitted_scale is not None:
        fitted_scale.draw_bar(ax, mappable(fitted_scale))
    return ax


def checked_surface(points: ArrayLike, triangles: ArrayLike) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Check the points and triangles of a surface, and return them as arrays. Raises `ValueError` for other shapes,
    points that are not finite, and indices out of range."""
    point_array, triangle_array = np.asarray(points), np.asarray(triangles)
    if point_array.ndim != 2 or point_array.shape[1] != 3 or not np.issubdtype(point_array.dtype, np.number):
        raise ValueError(f"points has shape {point_array.shape}; give (n, 3), metres.")
    if not np.isfinite(point_array).all():
        raise ValueError("points must be finite, in metres.")
    if (
        triangle_array.ndim != 2
        or triangle_array.shape[1] != 3
        or len(triangle_array) == 0
        or not np.issubdtype(triangle_array.dtype, np.integer)
    ):
        raise ValueError(
            f"triangles has shape {triangle_array.shape} of {triangle_array.dtype}; give (m, 3) whole numbers of "
            "points."
        )
    if triangle_array.min() < 0 or triangle_array.max() >= len(point_array):
        raise ValueError(
            f"triangles names point {int(triangle_array.max())}; there are {len(point_array)}, counted from 0."
        )
    return point_array.astype(float), triangle_array


def checked_values(values: ArrayLike, num_points: int, num_triangles: int) -> Float[np.ndarray, " k"]:
    """Check the values of a surface per triangle or per point, and return them as an array. Raises `ValueError` for
    another shape and for complex values."""
    image = np.asarray(values)
    if image.shape not in ((num_triangles,), (num_points,)):
        raise ValueError(
            f"values has shape {image.shape}; give one for each of the {num_triangles} triangles or the {num_points} "
            "points."
        )
    if np.iscomplexobj(image):
        raise ValueError("values are complex; draw their real or imaginary part.")
    return image


def colours_of(fitted: FittedScale, values: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 4"]:
    """Colours (m, 4) of values in a fitted colour scale."""
    return colormaps[fitted.keywords["cmap"]](_normalise(fitted)(fitted.factor * np.asarray(values)))


def mappable(fitted: FittedScale) -> ScalarMappable:
    """Create a matplotlib mappable with the fitted colour scale, for a colour bar."""
    return ScalarMappable(_normalise(fitted), fitted.keywords["cmap"])


def _normalise(fitted: FittedScale) -> Normalize:
    return Normalize(fitted.keywords["vmin"], fitted.keywords["vmax"])
