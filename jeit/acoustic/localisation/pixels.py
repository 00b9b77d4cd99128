"""The grid of pixels on which losses are evaluated, and losses drawn over the skin."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.acoustic.surface import chart_grid
from jeit_solvers.engines import as_array, namespace, set_at

# A second valley is descended if its screened value is at most this factor times the best plus this offset; on rasters
# with more pixels only the best valley is descended.
_WORTH, _WORTH_MORE, _FINE = 1.5, 8.0, 2000


class Pixels(eqx.Module):
    """A raster over the outline's box: chart coordinates (2, P), which are `inside` (P,), rows and columns, and
    whether all are inside (`full`)."""

    chart: Float[Array, "2 P"]
    inside: Bool[Array, " P"]
    shape: tuple[int, int] = eqx.field(static=True)
    full: bool = eqx.field(static=True)

    @classmethod
    def create(cls, surface, columns: int, rows: int) -> "Pixels":
        """Create a raster of rows × columns pixels, bottom row first. Raises `ValueError` where no pixel lies inside
        the outline."""
        grid, within = chart_grid(surface, columns, rows)
        if not within.any():
            raise ValueError(f"shape: none of {columns} × {rows} pixels has its middle inside the outline; take more.")
        return cls(as_array(grid.reshape(2, -1)), as_array(within.ravel()), (rows, columns), bool(within.all()))


def valleys(maps: Float[Array, "F P"], pixels: Pixels) -> tuple[Array, Array, Array]:
    """Chart coordinates (2, F) of the minimum pixel of each map and of the lowest other local minimum, and a mask (F,)
    of the frames where the latter is worth a descent."""
    rows, columns = pixels.shape
    inside, xp = pixels.inside.reshape(rows, columns), namespace(maps, pixels)

    def known(values, inside):
        fair = ~xp.isnan(values) if pixels.full else inside & ~xp.isnan(values)
        return xp.where(fair, values, xp.inf)

    # First the row of the minimum, then the pixel in it, which is faster than a search over all pixels.
    square = maps.reshape(-1, rows, columns)
    row = xp.argmin(xp.min(known(square, inside), axis=2), axis=1)
    in_row = known(xp.take_along_axis(square, row[:, None, None], axis=1)[:, 0], inside[row])
    best = row * columns + xp.argmin(in_row, axis=1)
    first = pixels.chart[:, best]
    if rows * columns > _FINE:  # on such fine rasters, noise causes spurious valleys
        return first, first, xp.zeros(best.shape, bool)
    square = known(square, inside)
    values = square.reshape(len(best), -1)
    wide = xp.pad(square, ((0, 0), (1, 1), (1, 1)), constant_values=xp.inf)
    around = [wide[:, i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    lowest = xp.isfinite(square)
    for neighbour in around:
        lowest &= square <= neighbour
    lowest = set_at(lowest.reshape(values.shape), (xp.arange(len(best)), best), False)
    rivals = xp.where(lowest, values, xp.inf)
    other = xp.argmin(rivals, axis=1)
    least, second = xp.min(values, axis=1), xp.min(rivals, axis=1)
    return first, pixels.chart[:, other], second < _WORTH * least + _WORTH_MORE


def brightness(
    maps: ArrayLike, *, method: str = "likelihood", share: float = 0.02
) -> Float[np.ndarray, "F rows columns"]:
    """Brightness of each pixel from the maps of frames: 1 at the best pixel of each map, falling to 0; 0 outside the
    outline.

    `maps` (F, rows, columns), as from `Localiser.with_maps`. For "likelihood" maps it is the likelihood relative to the
    best pixel's, exp(−(map − least)). The paper's loss ("consistency") has no such scale: its brightness falls to 1/e
    where the loss is that of the best `share` of the pixels. Raises `ValueError` for other methods or shapes.
    """
    values = np.asarray(maps, float)
    if values.ndim != 3:
        raise ValueError(f"maps has shape {values.shape}; give (frames, rows, columns).")
    if method not in ("likelihood", "consistency"):
        raise ValueError(f"method must be likelihood or consistency; it is {method!r}.")
    if not 0 < share < 1:
        raise ValueError(f"share must be between 0 and 1; it is {share}.")
    flat = np.where(np.isnan(values), np.inf, values).reshape(len(values), -1)
    least = flat.min(axis=1, keepdims=True)
    known = np.isfinite(least)
    least = np.where(known, least, 0.0)
    scale = 1.0
    if method == "consistency":
        rank = max(1, int(share * np.isfinite(flat).sum(axis=1).max(initial=1)))
        scale = np.partition(flat, min(rank, flat.shape[1] - 1), axis=1)[:, [min(rank, flat.shape[1] - 1)]] - least
        scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
    return np.where(known, np.exp(-(flat - least) / scale), 0.0).reshape(values.shape)


def overlay(images: ArrayLike, times: ArrayLike, *, time_constant: float = 0.3) -> Float[np.ndarray, "F rows columns"]:
    """Overlay every frame with those before it, which fade as exp(−age / `time_constant`): (F, rows, columns).

    `images` (F, rows, columns), zero where there is no touch, NaN counts as zero; `times` (F,) in seconds, increasing.
    Each pixel shows the maximum of the faded frames, so that a source at rest does not saturate. The last image is the
    picture of the whole recording. Raises `ValueError` for shapes that disagree and a time constant that is not
    positive.
    """
    frames, when = np.nan_to_num(np.asarray(images, float)), np.asarray(times, float)
    if frames.ndim != 3 or when.shape != (len(frames),) or not len(frames):
        raise ValueError(f"images has shape {frames.shape} and times {when.shape}; give (F, rows, columns) and (F,).")
    if not (np.diff(when) > 0).all():
        raise ValueError("times must increase, in seconds.")
    if not (np.isfinite(time_constant) and time_constant > 0):
        raise ValueError(f"time_constant must be positive, in seconds; it is {time_constant}.")
    result = np.empty_like(frames)
    left = np.zeros_like(frames[0])
    for number, fade in enumerate(np.exp(-np.diff(when, prepend=when[0]) / time_constant)):
        left = np.maximum(fade * left, frames[number])
        result[number] = left
    return result


def fade(images: ArrayLike, times: ArrayLike, *, at: float, time_constant: float) -> Float[np.ndarray, "rows columns"]:
    """Faded overlay of some frames `at` a time (seconds): the last picture of their `overlay`, without computing the
    others.

    For a long recording, the picture of the whole is the maximum of the pictures of its parts.
    """
    age = np.maximum(at - np.asarray(times, float), 0.0)
    weight = np.exp(-age / time_constant)
    return np.max(np.nan_to_num(np.asarray(images, float)) * weight[:, None, None], axis=0)
