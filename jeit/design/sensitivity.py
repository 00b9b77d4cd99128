"""Sensitivity maps: the norm of the voltage changes due to a touch at each of many positions of a skin."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.design.defaults import CONTRAST
from jeit.design.skin.touch_shapes import AbstractIndentation, Bell, TouchGrid, check_grid
from jeit.design.skin.touched_cells import touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit_solvers.engines import has_values, namespace, numpy_or_compiled
from jeit_solvers.module import Module


@numpy_or_compiled
def uniformity(sensitivities: Float[Array, "*maps n"]) -> Float[Array, "*maps"]:
    """Mean of the sensitivity Θ over n positions divided by its root mean square: 1 if all values are equal, and
    smaller the more the values differ."""
    return sensitivities.mean(axis=-1) / namespace(sensitivities).sqrt((sensitivities**2).mean(axis=-1))


@numpy_or_compiled
def _fraction_below_level(sensitivity_level, sensitivities: Float[Array, "*maps n"]) -> Float[Array, "*maps"]:
    return (sensitivities < sensitivity_level).astype(sensitivities.dtype).mean(axis=-1)


class SensitivityMap(Module):
    """Sensitivity Θ of a skin at n positions: the norm ‖Δv‖₂ of the voltage changes Δv due to a touch at the position
    (Park et al. 2022).

    **Fields**: `grid`: the touched positions; `changes`: Δv (n, M) in the M channels of the protocol, volts.
    """

    grid: TouchGrid
    changes: Float[Array, "n M"]

    @property
    @numpy_or_compiled
    def values(self) -> Float[Array, " n"]:
        """Sensitivity Θ (n,) at each touched position, volts."""
        return namespace(self.changes).linalg.norm(self.changes, axis=-1)

    @property
    @numpy_or_compiled
    def minimum(self) -> Float[Array, ""]:
        """Minimum of the sensitivity Θ over the touched positions, volts."""
        return self.values.min(axis=-1)

    @property
    @numpy_or_compiled
    def mean(self) -> Float[Array, ""]:
        """Mean of the sensitivity Θ over the touched positions, volts."""
        return self.values.mean(axis=-1)

    @property
    @numpy_or_compiled
    def uniformity(self) -> Float[Array, ""]:
        """Mean of the sensitivity Θ divided by its root mean square: 1 if all positions have the same Θ, and smaller
        the more Θ varies."""
        return uniformity(self.values)

    def blind_spot(self, level) -> Float[Array, ""]:
        """Fraction of the skin's area that is less sensitive than `level` (volts), such as the lowest sensitivity of a
        different layout.

        Raises `ValueError` if `level` is negative or not a number.
        """
        if has_values(level) and not np.all(np.asarray(level) >= 0):
            raise ValueError(f"level must be a sensitivity in volts, not negative; it is {level!r}.")
        return _fraction_below_level(level, self.values)

    def histogram(self, bins: int | np.ndarray = 40) -> tuple[np.ndarray, np.ndarray]:
        """Fraction of the skin's area in each bin of the sensitivity Θ, and the edges of the bins in volts; `bins` as
        in `numpy.histogram`."""
        bin_counts, bin_edges = np.histogram(np.asarray(self.values), bins=bins)
        return bin_counts / self.values.size, bin_edges

    def image(self) -> Float[np.ndarray, "rows columns"]:
        """Sensitivity Θ as an image (rows, columns), volts, with row 0 at the smallest y, and NaN outside the skin."""
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
    """Compute the sensitivity map of a skin from the voltage changes due to touches at every position of a grid.

    **Arguments:**

    - `model`: forward model of the skin.
    - `conductivity`: conductivity of the model, S/m (2-D: S).
    - `grid`: the touched positions.
    - `indentation`: shape of the touch, by default the unit deformation `Bell()` of Park et al. 2022.
    - `thickness`: thickness of the layer that a sheet represents, metres; None for a layer.
    - `contrast`: conductivity of the touched part divided by that of the rest of the skin.
    - `linear`: whether to compute linearised instead of exact voltage changes.

    Raises `ValueError` if the model, the grid and the thickness are not compatible, and for invalid values.

    **Example:**

    ```python
    theta = sensitivity_map(sheet.model, sheet.model_conductivity, touches, thickness=0.01)
    print(theta.minimum, theta.mean)  # volts
    ```
    """
    check_model(model)
    check_grid(grid)
    touched = touched_cells(model.mesh, indentation or Bell(), grid.places, thickness=thickness, contrast=contrast)
    return SensitivityMap(grid, touch_changes(model, conductivity, touched, linear=linear))
