"""Rasters over a skin, and the valleys of maps on them."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool, Float

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
