"""Rasters: grids of pixels on which images on the cells of a mesh are sampled; the GREIT figures of merit of images on
a raster, and the score of the Kuopio Tomography Challenge 2023.

Adler et al., "GREIT: a unified approach to 2D linear EIT reconstruction of lung images", Physiol. Meas. 30 (2009)
S35-S55.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact, Int

from jeit.arguments import object_html, object_text, picture
from jeit.mesh import Mesh, check_flat
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled
from jeit_solvers.module import Module


class Raster(Module):
    """Grid of pixels, with the cell of a mesh that contains each pixel; one raster serves all images on a mesh.

    **Fields**: `cell`: (rows, columns) index of the cell that contains the centre of each pixel, or -1 outside the
    mesh; row 0 is at the top (largest y), column 0 at the left; `extent`: (x_min, x_max, y_min, y_max) in metres, the
    outer edges of the outermost pixels.

    **Example:**

    ```python
    raster = Raster.create(mesh, shape=(64, 64))
    raster.sample(image), raster.extent
    ```
    """

    cell: Int[Array, "rows columns"]
    extent: tuple[float, float, float, float] = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        mesh: Mesh,
        *,
        shape: tuple[int, int] = (256, 256),
        extent: tuple[float, float, float, float] | None = None,
        height: float | None = None,
    ) -> "Raster":
        """Make a raster of a mesh. `shape`: (rows, columns). `extent`: (x_min, x_max, y_min, y_max) in metres; by
        default the smallest square around the mesh. `height`: z in metres of the slice through a 3-D mesh, by default
        half of its height. Raises `ValueError` for an empty extent, and for a surface in space."""
        check_flat(mesh, "rasters")
        points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
        low, high = points.min(axis=0), points.max(axis=0)
        if extent is None:
            centre, half_side = (low + high)[:2] / 2, (high - low)[:2].max() / 2
            extent = (centre[0] - half_side, centre[0] + half_side, centre[1] - half_side, centre[1] + half_side)
        x_min, x_max, y_min, y_max = (float(value) for value in extent)
        if not (x_max > x_min and y_max > y_min) or min(shape) < 1:
            raise ValueError(f"extent {extent} must be (x_min, x_max, y_min, y_max) in metres, and shape positive.")
        rows, columns = shape
        x = x_min + (np.arange(columns) + 0.5) * (x_max - x_min) / columns
        y = y_max - (np.arange(rows) + 0.5) * (y_max - y_min) / rows
        if mesh.dimension == 3:
            height = (low[2] + high[2]) / 2 if height is None else float(height)
        cell = _cells_of_pixels(points, cells, x, y, height if mesh.dimension == 3 else None)
        return cls(as_array(cell, np.int32), (x_min, x_max, y_min, y_max))

    @property
    def pixel_area(self) -> float:
        """Area of a pixel in m²."""
        x_min, x_max, y_min, y_max = self.extent
        return (x_max - x_min) * (y_max - y_min) / self.cell.size

    def pixel_centres(self) -> np.ndarray:
        """Centres of the pixels (rows, columns, 2) in metres."""
        rows, columns = self.cell.shape
        x_min, x_max, y_min, y_max = self.extent
        x = x_min + (np.arange(columns) + 0.5) * (x_max - x_min) / columns
        y = y_max - (np.arange(rows) + 0.5) * (y_max - y_min) / rows
        return np.stack(np.meshgrid(x, y), axis=-1)

    def sample(self, image: Inexact[Array, "*frames m"]) -> Float[Array, "*frames rows columns"]:
        """Values at the pixels of one image (m,) or several images (frames, m) on m cells; NaN outside the mesh."""
        return _sample(self.cell, image)


@numpy_or_compiled
def _sample(cell, image):
    xp = namespace(cell, image)
    return xp.where(cell >= 0, image[..., xp.maximum(cell, 0)], xp.nan)


def _cells_of_pixels(points, cells, x, y, height: float | None) -> Int[np.ndarray, "rows columns"]:
    """Index of the cell that contains each pixel centre (`x` ascending, `y` descending and, in a solid, `height`,
    metres), or -1 outside all cells. Of several cells that meet at a pixel, the cell with the nearest centroid is
    taken.

    Every cell is tested at the pixels in the rectangle around it.
    """
    corners = points[cells]
    low, high, tolerance = corners.min(axis=1), corners.max(axis=1), 1e-9 * np.ptp(points, axis=0).max()
    # First pixel, and number of pixels, in the rectangle around every cell, along rows and columns.
    first_row = np.searchsorted(-y, -high[:, 1] - tolerance)
    first_column = np.searchsorted(x, low[:, 0] - tolerance)
    num_rows = np.searchsorted(-y, -low[:, 1] + tolerance, side="right") - first_row
    num_columns = np.searchsorted(x, high[:, 0] + tolerance, side="right") - first_column
    num_pixels = num_rows * num_columns
    if height is not None:
        num_pixels[(low[:, 2] > height + tolerance) | (high[:, 2] < height - tolerance)] = 0
    cells_with_pixels = np.flatnonzero(num_pixels)
    inverse, centroid = np.zeros((len(cells), *corners[0, 1:].shape)), corners.mean(axis=1)
    inverse[cells_with_pixels] = np.linalg.inv(
        np.swapaxes(corners[cells_with_pixels, 1:] - corners[cells_with_pixels, :1], 1, 2)
    )
    cell = np.repeat(np.arange(len(cells)), num_pixels)
    pixel = np.arange(len(cell)) - np.repeat(np.cumsum(num_pixels) - num_pixels, num_pixels)
    row, column = np.divmod(pixel, num_columns[cell])
    row, column = row + first_row[cell], column + first_column[cell]
    position = [x[column], y[row]] if height is None else [x[column], y[row], np.full(len(cell), height)]
    offset = [coordinate - corners[cell, 0, axis] for axis, coordinate in enumerate(position)]
    barycentric = [sum(inverse[cell, i, j] * offset[j] for j in range(len(offset))) for i in range(len(offset))]
    is_inside = np.minimum(np.minimum.reduce(barycentric), 1 - sum(barycentric)) > -1e-9
    distance = np.sum([(coordinate - centroid[cell, axis]) ** 2 for axis, coordinate in enumerate(position)], axis=0)
    sort_order = np.argsort(-distance[is_inside], kind="stable")  # the nearest cell of a pixel is assigned last
    cell_of_pixel = np.full((len(y), len(x)), -1)
    cell_of_pixel[row[is_inside][sort_order], column[is_inside][sort_order]] = cell[is_inside][sort_order]
    return cell_of_pixel


# Pixels above this fraction of the image's maximum belong to the target.
_RELATIVE_TARGET_THRESHOLD = 0.25


class FiguresOfMerit(Module):
    """GREIT figures of merit of images, each of one target; every field has one value per target.

    Let x be an image, positive for a change of the target's sign. The quarter-amplitude set Q consists of the pixels
    with x ≥ max(x) / 4. C is the disc centred at the centre of gravity of Q with the area of Q.

    **Fields**

    - `amplitude_response`: AR = ∫x / (area of the target · change of the target), dimensionless. AR is 1 if the image
      contains as much change as the target, and should be the same at all positions.
    - `position_error`: PE = r_t - r_q, metres, where r_t and r_q are the distances of the target and of the centre of
      gravity of Q from the centre of the body. **Positive if the target is imaged too near to the centre.** Ideally
      zero. A displacement of the image around the centre does not affect PE.
    - `resolution`: RES = √(area of Q / area of the body), dimensionless: the radius of a disc with the area of Q,
      divided by `body_radius`. RES is ideally small, and the same at all positions.
    - `shape_deformation`: SD = (area of Q outside C) / (area of Q), dimensionless, 0 for a round image.
    - `ringing`: RNG = -(∫x over the pixels outside C where x < 0) / (∫x over C), dimensionless and not negative: change
      of the wrong sign around the target, relative to the change in the target. Ideally zero.
    - `distance`: r_t, distance of the target from the centre of the body, metres.
    - `body_radius`: radius in metres of the disc with the area of the body; lengths divided by this radius can be
      compared between bodies.

    All fields except `amplitude_response`, `distance` and `body_radius` are NaN for an image without a pixel of the
    target's sign, because Q is then empty. The ringing is infinite if the net change in C does not have the target's
    sign.

    **Example:**

    ```python
    figures = figures_of_merit(raster.sample(image), raster.extent, [0.04, 0.0], area=1e-3)
    figures.position_error, figures.resolution
    ```
    """

    amplitude_response: Float[Array, "*targets"]
    position_error: Float[Array, "*targets"]
    resolution: Float[Array, "*targets"]
    shape_deformation: Float[Array, "*targets"]
    ringing: Float[Array, "*targets"]
    distance: Float[Array, "*targets"]
    body_radius: Float[Array, "*targets"]

    def __repr__(self) -> str:
        return object_text(self._summary_text, self)

    def _summary_text(self) -> str:
        medians = {name: float(np.median(np.asarray(value))) for name, value in vars(self).items()}
        targets = f"medians of {np.size(self.distance)} targets: " if np.ndim(self.distance) else ""
        return (
            f"FiguresOfMerit({targets}amplitude response {medians['amplitude_response']:.3g}, position error "
            f"{1e3 * medians['position_error']:.3g} mm,\n  resolution {medians['resolution']:.3g}, shape deformation "
            f"{medians['shape_deformation']:.3g}, ringing {medians['ringing']:.3g})"
        )

    def _repr_png_(self) -> bytes | None:
        return picture(self)

    def _repr_html_(self) -> str | None:
        return object_html(self)


def figures_of_merit(
    raster: Float[Array, "*targets rows columns"],
    extent: tuple[float, float, float, float],
    position: Float[Array, "*targets 2"],
    *,
    area: Float[Array, "*targets"] | float,
    change: Float[Array, "*targets"] | float = 1.0,
) -> FiguresOfMerit:
    """GREIT figures of merit of one image or of several images, each of one target. The centre of the body is the
    centre of gravity of its pixels.

    The function works under `jax.jit` and `jax.vmap`.

    **Arguments:**

    - `raster` (rows, columns) or (T, rows, columns) for T targets: change of conductivity on pixels, NaN outside the
      body, as returned by `Raster.sample`, row 0 at the top.
    - `extent`: (x_min, x_max, y_min, y_max), edges of the raster in metres.
    - `position` (2,) or (T, 2): centre of each target in metres.
    - `area`: area of each target in m², a number or (T,).
    - `change`: change of conductivity of each target, negative for a resistive target, in the unit of the raster; a
      number or (T,).

    Raises `ValueError` for arguments whose shapes do not match or whose values are invalid.

    **Example:**

    ```python
    figures = figures_of_merit(raster.sample(image), raster.extent, [0.04, 0.0], area=1e-3)
    ```
    """
    if jnp.iscomplexobj(raster) or jnp.iscomplexobj(change):
        raise ValueError("raster and change must be real; judge the real and the imaginary part of an image apart.")
    raster, position, area, change = (jnp.asarray(values, float) for values in (raster, position, area, change))
    _check_arguments(raster, extent, position, area, change)
    return _figures_of_merit(raster, jnp.asarray(extent, float), position, area, change)


@jax.jit
def _figures_of_merit(raster, extent, position, area, change):
    if raster.ndim == 2:
        return _figures_of_one_image(raster, extent, position, area, change)
    area, change = jnp.broadcast_to(area, len(raster)), jnp.broadcast_to(change, len(raster))
    return jax.vmap(_figures_of_one_image, in_axes=(0, None, 0, 0, 0))(raster, extent, position, area, change)


def _figures_of_one_image(raster, extent, position, area, change):
    rows, columns = raster.shape
    x_min, x_max, y_min, y_max = extent
    x = x_min + (jnp.arange(columns) + 0.5) * (x_max - x_min) / columns
    y = (y_max - (jnp.arange(rows) + 0.5) * (y_max - y_min) / rows)[:, None]
    pixel_area = (x_max - x_min) * (y_max - y_min) / raster.size
    is_body_pixel = jnp.isfinite(raster)
    value = jnp.where(is_body_pixel, raster, 0) / change  # positive values have the target's sign
    max_value = value.max()
    target_pixels = is_body_pixel & (value >= _RELATIVE_TARGET_THRESHOLD * max_value) & (max_value > 0)
    body_centre, body_size = _centre_of_gravity(is_body_pixel, x, y), jnp.sum(is_body_pixel)
    target_centre, target_size = _centre_of_gravity(target_pixels, x, y), jnp.sum(target_pixels)
    is_in_circle = (x - target_centre[0]) ** 2 + (y - target_centre[1]) ** 2 <= target_size * pixel_area / jnp.pi
    distance = jnp.hypot(*(position - body_centre))
    circle_sum = jnp.sum(jnp.where(is_in_circle, value, 0))
    negative_sum = -jnp.sum(jnp.where(is_in_circle, 0, jnp.minimum(value, 0)))
    return FiguresOfMerit(
        amplitude_response=jnp.sum(value) * pixel_area / area,
        position_error=distance - jnp.hypot(*(target_centre - body_centre)),
        resolution=jnp.sqrt(jnp.where(target_size > 0, target_size, jnp.nan) / body_size),
        shape_deformation=jnp.sum(target_pixels & ~is_in_circle) / target_size,
        ringing=jnp.where(target_size > 0, jnp.where(circle_sum > 0, negative_sum / circle_sum, jnp.inf), jnp.nan),
        distance=distance,
        body_radius=jnp.sqrt(body_size * pixel_area / jnp.pi),
    )


def _centre_of_gravity(is_inside, x, y):
    """Centre of gravity of the pixels in the mask `is_inside`; NaN for an empty mask."""
    size = jnp.sum(is_inside)
    return jnp.stack([jnp.sum(jnp.where(is_inside, x, 0)), jnp.sum(jnp.where(is_inside, y, 0))]) / size


def _check_arguments(raster, extent, position, area, change) -> None:
    if raster.ndim not in (2, 3):
        raise ValueError(
            f"raster has shape {raster.shape}; give one image (rows, columns) or many (targets, rows, columns)."
        )
    targets = raster.shape[:-2]
    if position.shape != (*targets, 2):
        raise ValueError(
            f"position has shape {position.shape}; give (x, y) in metres of the target of each image, {(*targets, 2)}."
        )
    for name, values in (("area", area), ("change", change)):
        if values.shape not in ((), targets):
            raise ValueError(f"{name} has shape {values.shape}; give one number, or one for each of the images.")
    x_min, x_max, y_min, y_max = extent
    if not has_values(raster, position, area, change, extent):
        return
    if not (x_max > x_min and y_max > y_min):
        raise ValueError(f"extent {tuple(extent)} must be (x_min, x_max, y_min, y_max) in metres; see Raster.extent.")
    if not (np.isfinite(area) & (np.asarray(area) > 0)).all():
        raise ValueError("area of the targets must be positive, in square metres.")
    if not (np.isfinite(change) & (np.asarray(change) != 0)).all():
        raise ValueError("change of the targets must be finite and not zero, in siemens; negative where it falls.")
    is_body = np.isfinite(raster)
    if not is_body.any(axis=(-2, -1)).all():
        raise ValueError("raster: an image has no finite pixel; give a change of conductivity wherever the body is.")
    if is_body.ndim == 3 and (is_body != is_body[0]).any():
        raise ValueError(
            "raster: the images are NaN at different pixels; NaN stands for outside the body, which is the same for "
            "all. Was a reconstruction given NaN voltages?"
        )
    positions = np.asarray(position)
    if not ((positions >= [x_min, y_min]) & (positions <= [x_max, y_max])).all():
        raise ValueError(
            f"position: a target lies outside the raster, whose extent is {tuple(extent)}; are both in metres?"
        )


_WINDOW_DEVIATION = 80
_WINDOW_HALF_WIDTH = 160
_C1, _C2 = 1e-4, 9e-4
RESISTIVE, CONDUCTIVE = 1, 2


def challenge_score(labels: Int[np.ndarray, "256 256"], truth: Int[np.ndarray, "256 256"]) -> float:
    """Score of the Kuopio Tomography Challenge 2023: structural similarity (SSIM) of `labels` to the `truth`, averaged
    over the conductive and the resistive class; 1 is perfect.

    `labels`, `truth`: 256 × 256 pixels with the labels 0 background, 1 resistive and 2 conductive. The means, variances
    and covariance in the SSIM are computed in Gaussian windows with a standard deviation of 80 pixels, cut off at ±160
    pixels and normalised at the border. The constants that stabilise the quotients of the SSIM are c1 = 1e-4 and c2 =
    9e-4. The score of a class is the mean of the SSIM over all pixels, or 1 if neither image contains the class. Raises
    `ValueError` for images of the wrong shape or with other labels. Räsänen et al., KTC2023, doi
    10.5281/zenodo.8252370.
    """
    labels, truth = np.asarray(labels), np.asarray(truth)
    for name, image in (("labels", labels), ("truth", truth)):
        if image.shape != (256, 256) or not np.isin(image, (0, RESISTIVE, CONDUCTIVE)).all():
            raise ValueError(
                f"{name}: the score is for 256 × 256 pixels of 0 (background), 1 (resistive) and 2 (conductive); "
                f"got shape {image.shape} with values {np.unique(image)[:5].tolist()}."
            )
    return float(np.mean([_structural_similarity(labels == kind, truth == kind) for kind in (CONDUCTIVE, RESISTIVE)]))


def _structural_similarity(first_image: np.ndarray, second_image: np.ndarray) -> float:
    """Structural similarity (SSIM) of two masks, averaged over the pixels. Wang et al., IEEE Trans. Image Process. 13
    (2004)."""
    window = _gaussian_window(first_image.shape[0])
    # A mask equals its own square.
    a, b, product = (
        window @ image.astype(float) @ window.T for image in (first_image, second_image, first_image & second_image)
    )
    variance_a, variance_b, covariance = a - a**2, b - b**2, product - a * b
    luminance = (2 * a * b + _C1) / (a**2 + b**2 + _C1)
    return float(np.mean(luminance * (2 * covariance + _C2) / (variance_a + variance_b + _C2)))


@functools.cache
def _gaussian_window(size: int) -> np.ndarray:
    """Matrix (size, size) of normalised Gaussian weights along one image axis, one row per pixel. The two-dimensional
    window is the product of two such matrices."""
    distance = np.arange(size)[:, None] - np.arange(size)
    weight = np.where(np.abs(distance) <= _WINDOW_HALF_WIDTH, np.exp(-(distance**2) / (2 * _WINDOW_DEVIATION**2)), 0)
    return weight / weight.sum(axis=1, keepdims=True)
