"""Sensitivity maps: size of the voltage change for a change of conductivity, for each cell of a body."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from jeit.forward import ForwardModel
from jeit.mesh import measures
from jeit.plot.colour_scale import ColourScale
from jeit.plot.imaging.image import plot_image


def plot_sensitivity(
    model: ForwardModel, conductivity, *, title: str | None = None, height: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw ‖∂v/∂σ_e‖ / |e| of every cell, over all channels and relative to the largest, in decibels.

    Divided by the cell's area (3-D: volume), so that it does not show the mesh. `conductivity` as in
    `model.voltages`, scalar or per cell, in S (3-D: S/m); `height` as in `plot_image`. Raises `ValueError` for a
    conductivity per node.
    """
    jacobian = np.asarray(model.jacobian(conductivity))
    if jacobian.shape[1] != model.mesh.num_cells:
        raise ValueError("conductivity: give a scalar or one value per cell, for a sensitivity per cell.")
    density = np.linalg.norm(jacobian, axis=0) / np.asarray(measures(model.mesh))
    decibels = 20 * np.log10(np.maximum(density / density.max(), 1e-12))
    # Beside the ends of electrodes the field is singular: the scale begins where 1 % of the cells are brighter.
    ceiling = np.quantile(decibels, 0.99)
    quantity = "Sensitivity per area (dB)" if model.mesh.dimension == 2 else "Sensitivity per volume (dB)"
    return plot_image(
        model.mesh,
        np.minimum(decibels, ceiling) - ceiling,
        model.electrodes,
        scale=ColourScale(difference=False, quantity=quantity, unit="", limit=0.0, colour_map="magma"),
        title=title,
        height=height,
        ax=ax,
    )
