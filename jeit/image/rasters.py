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
        lower_corner, upper_corner = points.min(axis=0), points.max(axis=0)
        if extent is None:
            square_centre, half_side = (
                (lower_corner + upper_corner)[:2] / 2,
                (upper_corner - lower_corner)[:2].max() / 2,
            )
            extent = (
                square_centre[0] - half_side,
                square_centre[0] + half_side,
                square_centre[1] - half_side,
                square_centre[1] + half_side,
            )
        x_min, x_max, y_min, y_max = (float(value) for value in extent)
        if not (x_max > x_min and y_max > y_min) or min(shape) < 1:
            raise ValueError(f"extent {extent} must be (x_min, x_max, y_min, y_max) in metres, and shape positive.")
        num_rows, num_columns = shape
        x = x_min + (np.arange(num_columns) + 0.5) * (x_max - x_min) / num_columns
        y = y_max - (np.arange(num_rows) + 0.5) * (y_max - y_min) / num_rows
        if mesh.dimension == 3:
            height = (lower_corner[2] + upper_corner[2]) / 2 if height is None else float(height)
        cell_of_pixel = _cells_of_pixels(points, cells, x, y, height if mesh.dimension == 3 else None)
        return cls(as_array(cell_of_pixel, np.int32), (x_min, x_max, y_min, y_max))

    @property
    def pixel_area(self) -> float:
        """Area of a pixel in m²."""
        x_min, x_max, y_min, y_max = self.extent
        return (x_max - x_min) * (y_max - y_min) / self.cell.size

    def pixel_centres(self) -> np.ndarray:
        """Centres of the pixels (rows, columns, 2) in metres."""
        num_rows, num_columns = self.cell.shape
        x_min, x_max, y_min, y_max = self.extent
        x = x_min + (np.arange(num_columns) + 0.5) * (x_max - x_min) / num_columns
        y = y_max - (np.arange(num_rows) + 0.5) * (y_max - y_min) / num_rows
        return np.stack(np.meshgrid(x, y), axis=-1)

    def sample(self, image: Inexact[Array, "*frames m"]) -> Float[Array, "*frames rows columns"]:
        """Values at the pixels of one image (m,) or several images (frames, m) on m cells; NaN outside the mesh."""
        return _sample_at_pixels(self.cell, image)


@numpy_or_compiled
def _sample_at_pixels(cell_of_pixel, cell_values):
    xp = namespace(cell_of_pixel, cell_values)
    return xp.where(cell_of_pixel >= 0, cell_values[..., xp.maximum(cell_of_pixel, 0)], xp.nan)


def _cells_of_pixels(points, cells, x, y, height: float | None) -> Int[np.ndarray, "rows columns"]:
    """Index of the cell that contains each pixel centre (`x` ascending, `y` descending and, in a solid, `height`,
    metres), or -1 outside all cells. If several cells meet at a pixel centre, the cell with the nearest centroid is
    used.

    Every cell is tested at the pixels in the rectangle around it.
    """
    corners = points[cells]
    lower_corners, upper_corners, tolerance = (
        corners.min(axis=1),
        corners.max(axis=1),
        1e-9 * np.ptp(points, axis=0).max(),
    )
    # Index of the first pixel and number of pixels, along rows and columns, in the rectangle around every cell.
    first_row = np.searchsorted(-y, -upper_corners[:, 1] - tolerance)
    first_column = np.searchsorted(x, lower_corners[:, 0] - tolerance)
    num_rows = np.searchsorted(-y, -lower_corners[:, 1] + tolerance, side="right") - first_row
    num_columns = np.searchsorted(x, upper_corners[:, 0] + tolerance, side="right") - first_column
    num_pixels = num_rows * num_columns
    if height is not None:
        num_pixels[(lower_corners[:, 2] > height + tolerance) | (upper_corners[:, 2] < height - tolerance)] = 0
    cells_with_pixels = np.flatnonzero(num_pixels)
    barycentric_matrices, cell_centroids = np.zeros((len(cells), *corners[0, 1:].shape)), corners.mean(axis=1)
    barycentric_matrices[cells_with_pixels] = np.linalg.inv(
        np.swapaxes(corners[cells_with_pixels, 1:] - corners[cells_with_pixels, :1], 1, 2)
    )
    candidate_cells = np.repeat(np.arange(len(cells)), num_pixels)
    pixel_in_rectangle = np.arange(len(candidate_cells)) - np.repeat(np.cumsum(num_pixels) - num_pixels, num_pixels)
    pixel_rows, pixel_columns = np.divmod(pixel_in_rectangle, num_columns[candidate_cells])
    pixel_rows, pixel_columns = pixel_rows + first_row[candidate_cells], pixel_columns + first_column[candidate_cells]
    pixel_positions = (
        [x[pixel_columns], y[pixel_rows]]
        if height is None
        else [x[pixel_columns], y[pixel_rows], np.full(len(candidate_cells), height)]
    )
    corner_offsets = [coordinate - corners[candidate_cells, 0, axis] for axis, coordinate in enumerate(pixel_positions)]
    barycentric_coordinates = [
        sum(barycentric_matrices[candidate_cells, i, j] * corner_offsets[j] for j in range(len(corner_offsets)))
        for i in range(len(corner_offsets))
    ]
    is_inside = np.minimum(np.minimum.reduce(barycentric_coordinates), 1 - sum(barycentric_coordinates)) > -1e-9
    squared_distances = np.sum(
        [(coordinate - cell_centroids[candidate_cells, axis]) ** 2 for axis, coordinate in enumerate(pixel_positions)],
        axis=0,
    )
    # Cells are sorted by decreasing distance, so that the nearest cell of a pixel is assigned last.
    sort_order = np.argsort(-squared_distances[is_inside], kind="stable")
    cell_of_pixel = np.full((len(y), len(x)), -1)
    cell_of_pixel[pixel_rows[is_inside][sort_order], pixel_columns[is_inside][sort_order]] = candidate_cells[is_inside][
        sort_order
    ]
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
        median_figures = {name: float(np.median(np.asarray(value))) for name, value in vars(self).items()}
        targets_text = f"medians of {np.size(self.distance)} targets: " if np.ndim(self.distance) else ""
        return (
            f"FiguresOfMerit({targets_text}amplitude response {median_figures['amplitude_response']:.3g}, position "
            f"error {1e3 * median_figures['position_error']:.3g} mm,\n  resolution "
            f"{median_figures['resolution']:.3g}, shape deformation "
            f"{median_figures['shape_deformation']:.3g}, ringing {median_figures['ringing']:.3g})"
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
    _check_merit_arguments(raster, extent, position, area, change)
    return _figures_of_merit(raster, jnp.asarray(extent, float), position, area, change)


@jax.jit
def _figures_of_merit(raster, extent, target_position, target_area, target_change):
    if raster.ndim == 2:
        return _figures_of_one_image(raster, extent, target_position, target_area, target_change)
    target_area, target_change = (
        jnp.broadcast_to(target_area, len(raster)),
        jnp.broadcast_to(target_change, len(raster)),
    )
    return jax.vmap(_figures_of_one_image, in_axes=(0, None, 0, 0, 0))(
        raster, extent, target_position, target_area, target_change
    )


def _figures_of_one_image(raster, extent, target_position, target_area, target_change):
    num_rows, num_columns = raster.shape
    x_min, x_max, y_min, y_max = extent
    x = x_min + (jnp.arange(num_columns) + 0.5) * (x_max - x_min) / num_columns
    y = (y_max - (jnp.arange(num_rows) + 0.5) * (y_max - y_min) / num_rows)[:, None]
    pixel_area = (x_max - x_min) * (y_max - y_min) / raster.size
    is_body_pixel = jnp.isfinite(raster)
    relative_change = jnp.where(is_body_pixel, raster, 0) / target_change  # positive values have the target's sign
    max_relative_change = relative_change.max()
    target_pixels = (
        is_body_pixel
        & (relative_change >= _RELATIVE_TARGET_THRESHOLD * max_relative_change)
        & (max_relative_change > 0)
    )
    body_centre, body_size = _centre_of_gravity(is_body_pixel, x, y), jnp.sum(is_body_pixel)
    target_centre, target_size = _centre_of_gravity(target_pixels, x, y), jnp.sum(target_pixels)
    is_in_circle = (x - target_centre[0]) ** 2 + (y - target_centre[1]) ** 2 <= target_size * pixel_area / jnp.pi
    target_distance = jnp.hypot(*(target_position - body_centre))
    change_in_circle = jnp.sum(jnp.where(is_in_circle, relative_change, 0))
    opposite_change_outside = -jnp.sum(jnp.where(is_in_circle, 0, jnp.minimum(relative_change, 0)))
    return FiguresOfMerit(
        amplitude_response=jnp.sum(relative_change) * pixel_area / target_area,
        position_error=target_distance - jnp.hypot(*(target_centre - body_centre)),
        resolution=jnp.sqrt(jnp.where(target_size > 0, target_size, jnp.nan) / body_size),
        shape_deformation=jnp.sum(target_pixels & ~is_in_circle) / target_size,
        ringing=jnp.where(
            target_size > 0,
            jnp.where(change_in_circle > 0, opposite_change_outside / change_in_circle, jnp.inf),
            jnp.nan,
        ),
        distance=target_distance,
        body_radius=jnp.sqrt(body_size * pixel_area / jnp.pi),
    )


def _centre_of_gravity(is_inside, x, y):
    """Centre of gravity of the pixels in the mask `is_inside`; NaN for an empty mask."""
    num_pixels = jnp.sum(is_inside)
    return jnp.stack([jnp.sum(jnp.where(is_inside, x, 0)), jnp.sum(jnp.where(is_inside, y, 0))]) / num_pixels


def _check_merit_arguments(raster, extent, target_position, target_area, target_change) -> None:
    if raster.ndim not in (2, 3):
        raise ValueError(
            f"raster has shape {raster.shape}; give one image (rows, columns) or many (targets, rows, columns)."
        )
    targets_shape = raster.shape[:-2]
    if target_position.shape != (*targets_shape, 2):
        raise ValueError(
            f"position has shape {target_position.shape}; give (x, y) in metres of the target of each image, "
            f"{(*targets_shape, 2)}."
        )
    for argument_name, argument_values in (("area", target_area), ("change", target_change)):
        if argument_values.shape not in ((), targets_shape):
            raise ValueError(
                f"{argument_name} has shape {argument_values.shape}; give one number, or one for each of the images."
            )
    x_min, x_max, y_min, y_max = extent
    if not has_values(raster, target_position, target_area, target_change, extent):
        return
    if not (x_max > x_min and y_max > y_min):
        raise ValueError(f"extent {tuple(extent)} must be (x_min, x_max, y_min, y_max) in metres; see Raster.extent.")
    if not (np.isfinite(target_area) & (np.asarray(target_area) > 0)).all():
        raise ValueError("area of the targets must be positive, in square metres.")
    if not (np.isfinite(target_change) & (np.asarray(target_change) != 0)).all():
        raise ValueError("change of the targets must be finite and not zero, in siemens; negative where it falls.")
    is_body = np.isfinite(raster)
    if not is_body.any(axis=(-2, -1)).all():
        raise ValueError("raster: an image has no finite pixel; give a change of conductivity wherever the body is.")
    if is_body.ndim == 3 and (is_body != is_body[0]).any():
        raise ValueError(
            "raster: the images are NaN at different pixels; NaN stands for outside the body, which is the same for "
            "all. Was a reconstruction given NaN voltages?"
        )
    position_array = np.asarray(target_position)
    if not ((position_array >= [x_min, y_min]) & (position_array <= [x_max, y_max])).all():
        raise ValueError(
            f"position: a target lies outside the raster, whose extent is {tuple(extent)}; are both in metres?"
        )


# Standard deviation and half-width of the Gaussian windows of the SSIM, in pixels, and constants that stabilise its
# quotients.
_SSIM_WINDOW_DEVIATION = 80
_SSIM_WINDOW_HALF_WIDTH = 160
_SSIM_C1, _SSIM_C2 = 1e-4, 9e-4
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
    for argument_name, label_image in (("labels", labels), ("truth", truth)):
        if label_image.shape != (256, 256) or not np.isin(label_image, (0, RESISTIVE, CONDUCTIVE)).all():
            raise ValueError(
                f"{argument_name}: the score is for 256 × 256 pixels of 0 (background), 1 (resistive) and 2 "
                f"(conductive); got shape {label_image.shape} with values {np.unique(label_image)[:5].tolist()}."
            )
    return float(
        np.mean(
            [
                _structural_similarity(labels == class_label, truth == class_label)
                for class_label in (CONDUCTIVE, RESISTIVE)
            ]
        )
    )


def _structural_similarity(first_mask: np.ndarray, second_mask: np.ndarray) -> float:
    """Structural similarity (SSIM) of two masks, averaged over the pixels. Wang et al., IEEE Trans. Image Process. 13
    (2004)."""
    gaussian_window = _gaussian_window(first_mask.shape[0])
    # The square of a mask equals the mask, so the local mean of its square equals its local mean.
    first_mean, second_mean, product_mean = (
        gaussian_window @ mask.astype(float) @ gaussian_window.T
        for mask in (first_mask, second_mask, first_mask & second_mask)
    )
    first_variance, second_variance, covariance = (
        first_mean - first_mean**2,
        second_mean - second_mean**2,
        product_mean - first_mean * second_mean,
    )
    luminance = (2 * first_mean * second_mean + _SSIM_C1) / (first_mean**2 + second_mean**2 + _SSIM_C1)
    return float(np.mean(luminance * (2 * covariance + _SSIM_C2) / (first_variance + second_variance + _SSIM_C2)))


@functools.cache
def _gaussian_window(image_size: int) -> np.ndarray:
    """Matrix (size, size) of normalised Gaussian weights along one image axis, one row per pixel. The two-dimensional
    window is the product of two such matrices."""
    pixel_distance = np.arange(image_size)[:, None] - np.arange(image_size)
    gaussian_weights = np.where(
        np.abs(pixel_distance) <= _SSIM_WINDOW_HALF_WIDTH,
        np.exp(-(pixel_distance**2) / (2 * _SSIM_WINDOW_DEVIATION**2)),
        0,
    )
    return gaussian_weights / gaussian_weights.sum(axis=1, keepdims=True)
