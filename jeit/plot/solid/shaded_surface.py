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
from jeit.plot.solid.scene import BODY, FROM_THE_CORNER, Camera, Scene, bare_in_space


def plot_surface(
    points: ArrayLike,
    triangles: ArrayLike,
    values: ArrayLike | None = None,
    electrodes: ElectrodeShapes | None = None,
    *,
    camera: Camera = FROM_THE_CORNER,
    scale: ColourScale = CHANGE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a surface in space.

    **Arguments:**

    - `points` (n, 3): metres.
    - `triangles` (m, 3): indices of points.
    - `values`: one per triangle or per point; without values, the surface is grey.
    - `electrodes`: from `jeit.electrodes.shapes_of`, drawn on the surface and numbered.
    - `camera`: direction of view.
    - `scale`: colour scale; default: for changes of sheet conductivity in S.
    - `title`: title of the plot.
    - `ax`: axes to draw in; default: new ones.

    Raises `ValueError` for arrays of other shapes, values that are not finite, and arguments of another type.

    **Example:**

    ```python
    from jeit.mesh import sphere
    ball = sphere(0.05, num_points=162)
    plot_surface(ball.points, ball.cells, ball.points[:, 2], scale=ColourScale(quantity="height", unit="m"))
    ```
    """
    places, faces = checked_surface(points, triangles)
    check_kind("camera", camera, Camera, "a Camera, such as Camera(azimuth=-60, elevation=25)")
    check_scale(scale)
    if electrodes is not None:
        check_kind("electrodes", electrodes, ElectrodeShapes, "ElectrodeShapes, of shapes_of(mesh, electrodes)")
    ax = axes_or_new(ax)
    scene, fitted = Scene(camera), None
    if values is None:
        colours = np.array(to_rgba(BODY))
    else:
        image = checked_values(values, len(places), len(faces))
        fitted = scale.of(image, "S")
        colours = colours_of(fitted, image if len(image) == len(faces) else image[faces].mean(axis=1))
    scene.add_triangles(places, faces, colours, smooth=True)
    if electrodes is not None:
        add_electrodes(scene, places, faces, electrodes)
    scene.draw(ax)
    bare_in_space(ax, camera, places, numbered=electrodes is not None)
    if electrodes is not None:
        number_electrodes(ax, scene, places, faces, electrodes, behind=False)
    if title is not None:
        ax.set_title(title)
    if fitted is not None:
        fitted.draw_bar(ax, mappable(fitted))
    return ax


def checked_surface(points: ArrayLike, triangles: ArrayLike) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Check the points and triangles of a surface, and return them as arrays. Raises `ValueError` for other shapes,
    points that are not finite, and indices out of range."""
    places, faces = np.asarray(points), np.asarray(triangles)
    if places.ndim != 2 or places.shape[1] != 3 or not np.issubdtype(places.dtype, np.number):
        raise ValueError(f"points has shape {places.shape}; give (n, 3), metres.")
    if not np.isfinite(places).all():
        raise ValueError("points must be finite, in metres.")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"triangles has shape {faces.shape} of {faces.dtype}; give (m, 3) whole numbers of points.")
    if faces.min() < 0 or faces.max() >= len(places):
        raise ValueError(f"triangles names point {int(faces.max())}; there are {len(places)}, counted from 0.")
    return places.astype(float), faces


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
