"""Rasters of pixels on which localisation objectives are evaluated, and images of touches computed from the maps."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.acoustic.surface import chart_grid
from jeit_solvers.engines import as_array, namespace, set_at
from jeit_solvers.module import Module

# Condition for a minimisation from the second valley of a map: the value at the second valley is less than this factor
# times the value at the best valley, plus this offset. On rasters with more than `_MAX_VALLEY_PIXELS` pixels, only the
# best valley is used.
_SECOND_VALLEY_FACTOR, _SECOND_VALLEY_OFFSET, _MAX_VALLEY_PIXELS = 1.5, 8.0, 2000


class Pixels(Module):
    """A raster of P pixels over the bounding box of an outline.

    **Fields**: `chart`: chart coordinates (2, P) of the pixels' centres in metres; `inside`: mask (P,) of the pixels
    inside the outline; `shape`: numbers of rows and columns; `full`: whether all pixels are inside.
    """

    chart: Float[Array, "2 P"]
    inside: Bool[Array, " P"]
    shape: tuple[int, int] = eqx.field(static=True)
    full: bool = eqx.field(static=True)

    @classmethod
    def create(cls, surface, columns: int, rows: int) -> "Pixels":
        """Create a raster of rows × columns pixels, bottom row first. Raises `ValueError` if no pixel lies inside the
        outline."""
        pixel_centres, is_inside = chart_grid(surface, columns, rows)
        if not is_inside.any():
            raise ValueError(f"shape: none of {columns} × {rows} pixels has its middle inside the outline; take more.")
        return cls(
            as_array(pixel_centres.reshape(2, -1)), as_array(is_inside.ravel()), (rows, columns), bool(is_inside.all())
        )


def find_two_lowest_minima(maps: Float[Array, "F P"], pixels: Pixels) -> tuple[Array, Array, Array]:
    """Find the two lowest local minima (valleys) of each of F maps of P pixels.

    Returns the chart coordinates (2, F) of the lowest pixel and of the second lowest local minimum, and the mask (F,)
    of the frames in which the second minimum is low enough to start a minimisation there.
    """
    rows, columns = pixels.shape
    is_inside, xp = pixels.inside.reshape(rows, columns), namespace(maps, pixels)

    def fill_outside(map_values, is_inside):
        is_valid_pixel = ~xp.isnan(map_values) if pixels.full else is_inside & ~xp.isnan(map_values)
        return xp.where(is_valid_pixel, map_values, xp.inf)

    # The row of the minimum is found first, and then the pixel in this row, which is faster than a single search.
    rasters = maps.reshape(-1, rows, columns)
    best_rows = xp.argmin(xp.min(fill_outside(rasters, is_inside), axis=2), axis=1)
    row_values = fill_outside(xp.take_along_axis(rasters, best_rows[:, None, None], axis=1)[:, 0], is_inside[best_rows])
    best_pixels = best_rows * columns + xp.argmin(row_values, axis=1)
    best_chart_positions = pixels.chart[:, best_pixels]
    if rows * columns > _MAX_VALLEY_PIXELS:  # fine rasters have spurious local minima
        return best_chart_positions, best_chart_positions, xp.zeros(best_pixels.shape, bool)
    rasters = fill_outside(rasters, is_inside)
    map_values = rasters.reshape(len(best_pixels), -1)
    padded_rasters = xp.pad(rasters, ((0, 0), (1, 1), (1, 1)), constant_values=xp.inf)
    neighbour_values = [
        padded_rasters[:, i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)
    ]
    is_local_minimum = xp.isfinite(rasters)
    for neighbour_raster in neighbour_values:
        is_local_minimum &= rasters <= neighbour_raster
    is_local_minimum = set_at(
        is_local_minimum.reshape(map_values.shape), (xp.arange(len(best_pixels)), best_pixels), False
    )
    other_minima = xp.where(is_local_minimum, map_values, xp.inf)
    second_pixels = xp.argmin(other_minima, axis=1)
    best_values, second_values = xp.min(map_values, axis=1), xp.min(other_minima, axis=1)
    return (
        best_chart_positions,
        pixels.chart[:, second_pixels],
        second_values < _SECOND_VALLEY_FACTOR * best_values + _SECOND_VALLEY_OFFSET,
    )


def map_brightness(
    maps: ArrayLike, *, method: str = "likelihood", share: float = 0.02
) -> Float[np.ndarray, "F rows columns"]:
    """Convert maps of the objective to brightness (F, rows, columns): 1 at the best pixel of each map, decreasing to 0
    as the objective increases, and 0 outside the outline.

    For the method "likelihood", brightness is the likelihood divided by the likelihood of the best pixel, exp(−(map −
    minimum)). For "consistency", brightness is exp(−(map − minimum) / scale), with the scale that makes the brightness
    1/e where the loss equals the quantile `share` of the loss over the pixels.

    **Arguments:**

    - `maps`: maps of the objective (F, rows, columns), as returned by `Localiser.maps`.
    - `method`: "likelihood" or "consistency", the method of the localiser.
    - `share`: quantile of the loss, between 0 and 1, for "consistency".

    Raises `ValueError` for an unknown `method`, maps that are not three-dimensional, and a `share` outside (0, 1).

    **Example:**

    ```python
    bright = map_brightness(loss_map[None])
    print(bright.max())  # 1
    ```
    """
    map_values = np.asarray(maps, float)
    if map_values.ndim != 3:
        raise ValueError(f"maps has shape {map_values.shape}; give (frames, rows, columns).")
    if method not in ("likelihood", "consistency"):
        raise ValueError(f"method must be likelihood or consistency; it is {method!r}.")
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1; it is {share}.")
    flat_maps = np.where(np.isnan(map_values), np.inf, map_values).reshape(len(map_values), -1)
    map_minimum = flat_maps.min(axis=1, keepdims=True)
    has_finite_minimum = np.isfinite(map_minimum)
    map_minimum = np.where(has_finite_minimum, map_minimum, 0.0)
    brightness_scale = 1.0
    if method == "consistency":
        rank_of_darkest = max(1, int(share * np.isfinite(flat_maps).sum(axis=1).max(initial=1)))
        brightness_scale = (
            np.partition(flat_maps, min(rank_of_darkest, flat_maps.shape[1] - 1), axis=1)[
                :, [min(rank_of_darkest, flat_maps.shape[1] - 1)]
            ]
            - map_minimum
        )
        brightness_scale = np.where(np.isfinite(brightness_scale) & (brightness_scale > 0), brightness_scale, 1.0)
    return np.where(has_finite_minimum, np.exp(-(flat_maps - map_minimum) / brightness_scale), 0.0).reshape(
        map_values.shape
    )


def overlay_images(
    images: ArrayLike, times: ArrayLike, *, time_constant: float = 0.3
) -> Float[np.ndarray, "F rows columns"]:
    """Overlay each image with the earlier images, which fade as exp(−age / `time_constant`).

    Each pixel of the result (F, rows, columns) is the maximum over the faded images, so that a source at rest does not
    saturate the pixel. The last image shows the whole recording.

    **Arguments:**

    - `images`: brightness (F, rows, columns) of each frame, zero where there is no touch; NaN counts as zero.
    - `times`: increasing times (F,) of the frames, seconds.
    - `time_constant`: time in which an image fades to 1/e, seconds.

    Raises `ValueError` for shapes that disagree, times that do not increase, and a time constant that is not positive.

    **Example:**

    ```python
    bright = map_brightness(np.stack([loss_map, loss_map]))
    faded = overlay_images(bright, times=[0.0, 0.1])
    ```
    """
    image_frames, frame_times = np.nan_to_num(np.asarray(images, float)), np.asarray(times, float)
    if image_frames.ndim != 3 or frame_times.shape != (len(image_frames),) or not len(image_frames):
        raise ValueError(
            f"images has shape {image_frames.shape} and times {frame_times.shape}; give (F, rows, columns) and (F,)."
        )
    if not (np.diff(frame_times) > 0).all():
        raise ValueError("times must increase, in seconds.")
    if not (np.isfinite(time_constant) and time_constant > 0):
        raise ValueError(f"time_constant must be positive, in seconds; it is {time_constant}.")
    overlaid_images = np.empty_like(image_frames)
    current_overlay = np.zeros_like(image_frames[0])
    for frame_index, fade_factor in enumerate(np.exp(-np.diff(frame_times, prepend=frame_times[0]) / time_constant)):
        current_overlay = np.maximum(fade_factor * current_overlay, image_frames[frame_index])
        overlaid_images[frame_index] = current_overlay
    return overlaid_images


def last_overlay_image(
    images: ArrayLike, times: ArrayLike, *, time: float, time_constant: float
) -> Float[np.ndarray, "rows columns"]:
    """Compute only the last image (rows, columns) of `overlay_images`, for the time `time` in seconds.

    A long recording can be processed in parts: the image of the whole recording is the maximum of the images of its
    parts.
    """
    time_since_frame = np.maximum(time - np.asarray(times, float), 0.0)
    fade_weights = np.exp(-time_since_frame / time_constant)
    return np.max(np.nan_to_num(np.asarray(images, float)) * fade_weights[:, None, None], axis=0)
