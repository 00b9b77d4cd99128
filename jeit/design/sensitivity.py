"""Sensitivity maps: the norm of the voltage changes of a skin by a touch at each position."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.design.defaults import CONTRAST
from jeit.design.skin.indentation import AbstractIndentation, Bell
from jeit.design.skin.touch_grid import TouchGrid, check_grid
from jeit.design.skin.touched_cells import touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit_solvers.engines import either_engine, has_values, namespace


@either_engine
def uniformity(sensitivity: Float[Array, "*maps n"]) -> Float[Array, "*maps"]:
    """Mean of Θ over n positions divided by its root mean square: 1 where all are equal, less the more they differ."""
    return sensitivity.mean(axis=-1) / namespace(sensitivity).sqrt((sensitivity**2).mean(axis=-1))


@either_engine
def _share_below(level, sensitivity: Float[Array, "*maps n"]) -> Float[Array, "*maps"]:
    return (sensitivity < level).astype(sensitivity.dtype).mean(axis=-1)


class SensitivityMap(eqx.Module):
    """Sensitivity Θ of a skin at n places: ‖Δv‖₂ of the voltages' changes Δv by a touch there (Park et al. 2022).

    - `grid`: the places; `changes`: (n, M) volts, Δv of the protocol's M channels.
    """

    grid: TouchGrid
    changes: Float[Array, "n M"]

    @property
    @either_engine
    def values(self) -> Float[Array, " n"]:
        """Θ (n,), volts."""
        return namespace(self.changes).linalg.norm(self.changes, axis=-1)

    @property
    @either_engine
    def minimum(self) -> Float[Array, ""]:
        """Least Θ, volts: the worst place."""
        return self.values.min(axis=-1)

    @property
    @either_engine
    def mean(self) -> Float[Array, ""]:
        """Mean Θ, volts."""
        return self.values.mean(axis=-1)

    @property
    @either_engine
    def uniformity(self) -> Float[Array, ""]:
        """Mean Θ divided by its root mean square: 1 where all positions are equal, less the more they differ."""
        return uniformity(self.values)

    def blind_spot(self, level) -> Float[Array, ""]:
        """Share of the area that is less sensitive than `level` (volts), such as another layout's minimum.

        Raises `ValueError` for a level that is negative or not a number.
        """
        if has_values(level) and not np.all(np.asarray(level) >= 0):
            raise ValueError(f"level must be a sensitivity in volts, not negative; it is {level!r}.")
        return _share_below(level, self.values)

    def histogram(self, bins: int | np.ndarray = 40) -> tuple[np.ndarray, np.ndarray]:
        """Share of the area in each of some bins of Θ, and the bins' edges in volts; `bins` as of `numpy.histogram`."""
        counts, edges = np.histogram(np.asarray(self.values), bins=bins)
        return counts / self.values.size, edges

    def image(self) -> Float[np.ndarray, "rows columns"]:
        """Θ as an image (rows, columns), row 0 at the least y, NaN off the skin."""
        return self.grid.raster(self.values)


def sensitivity_map(
    model: ForwardModel,
    conductivity: ArrayLike,
    grid: TouchGrid,
    *,
    indentation: AbstractIndentation | None = None,
    thickness: float | None = None,
    contrast: float = CONTRAST,
    linear: bool = False,
) -> SensitivityMap:
    """Compute the sensitivity map of a skin from the voltage changes by touches at every position of `grid`.

    `indentation`: the unit deformation of Park et al. 2022 unless given. `thickness` (a sheet's) and `contrast` as in
    `touched_cells`; `linear` as in `touch_changes`. Raises `ValueError` as they do.
    """
    check_model(model)
    check_grid(grid)
    touched = touched_cells(model.mesh, indentation or Bell(), grid.places, thickness=thickness, contrast=contrast)
    return SensitivityMap(grid, touch_changes(model, conductivity, touched, linear=linear))
