"""Rasters over a skin, and the valleys of maps on them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jeit.acoustic.surface import chart_grid

# Another valley is worth a descent if, screened, it is not worse than so many times the best and so much more; on
# rasters of more pixels only the best is descended.
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
        """Of so many pixels; bottom row first. Raises `ValueError` where none of them lies inside the outline."""
        grid, within = chart_grid(surface, columns, rows)
        if not within.any():
            raise ValueError(f"shape: none of {columns} × {rows} pixels has its middle inside the outline; take more.")
        return cls(jnp.asarray(grid.reshape(2, -1)), jnp.asarray(within.ravel()), (rows, columns), bool(within.all()))


def valleys(maps: Float[Array, "F P"], pixels: Pixels) -> tuple[Array, Array, Array]:
    """Chart coordinates (2, F) of each map's least pixel, and of the least local minimum elsewhere, with which frames
    have one worth a descent (F,)."""
    rows, columns = pixels.shape
    inside = pixels.inside.reshape(rows, columns)

    def known(values, inside):
        fair = ~jnp.isnan(values) if pixels.full else inside & ~jnp.isnan(values)
        return jnp.where(fair, values, jnp.inf)

    # The least row first, then the least pixel in it, which is quicker than to look for the pixel at once.
    square = maps.reshape(-1, rows, columns)
    row = jnp.argmin(jnp.min(known(square, inside), axis=2), axis=1)
    in_row = known(jnp.take_along_axis(square, row[:, None, None], axis=1)[:, 0], inside[row])
    best = row * columns + jnp.argmin(in_row, axis=1)
    first = pixels.chart[:, best]
    if rows * columns > _FINE:  # where pixels are that fine, noise makes valleys of its own
        return first, first, jnp.zeros(best.shape, bool)
    square = known(square, inside)
    values = square.reshape(len(best), -1)
    wide = jnp.pad(square, ((0, 0), (1, 1), (1, 1)), constant_values=jnp.inf)
    around = [wide[:, i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    lowest = jnp.isfinite(square)
    for neighbour in around:
        lowest &= square <= neighbour
    lowest = lowest.reshape(values.shape).at[jnp.arange(len(best)), best].set(False)
    rivals = jnp.where(lowest, values, jnp.inf)
    other = jnp.argmin(rivals, axis=1)
    least, second = jnp.min(values, axis=1), jnp.min(rivals, axis=1)
    return first, pixels.chart[:, other], second < _WORTH * least + _WORTH_MORE
