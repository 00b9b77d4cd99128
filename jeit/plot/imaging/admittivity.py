"""Images of complex admittivity: both parts side by side, each on its own scale."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jeit.electrodes import AbstractElectrodes
from jeit.mesh import Mesh
from jeit.plot.colour_scale import ColourScale
from jeit.plot.imaging.image import plot_image


def plot_admittivity(
    mesh: Mesh,
    values: ArrayLike,
    electrodes: AbstractElectrodes | None = None,
    *,
    difference: bool = True,
    limits: tuple[float | None, float | None] = (None, None),
    titles: tuple[str, str] = ("Conductivity σ", "Susceptivity ωε"),
    figure: Figure | None = None,
    **options: Any,
) -> tuple[Axes, Axes]:
    """Draw σ and ωε of complex `values` (m,) or (n,) in two pictures of one figure; S (3-D: S/m).

    `difference`: whether values are changes, centred at zero. `limits`: values at the ends of the two colour bars, the
    largest magnitude of each part unless given; a part that is much the smaller so shows, and its bar says how small.
    `figure`: to draw in, a new one unless given. Other options as for `plot_image`. Raises `ValueError` for values that
    are not complex, and as `plot_image` does.
    """
    image: Any = np.asarray(values)
    if not np.iscomplexobj(image):
        raise ValueError("values are real; draw them with plot_image.")
    if figure is None:
        figure = Figure(figsize=(11.5, 5), layout="constrained")
    beginning = "Change of " if difference else ""
    names = [f"{beginning}{name}" for name in ("conductivity σ", "susceptivity ωε")]
    first, second = (
        plot_image(
            mesh,
            part,
            electrodes,
            scale=ColourScale(difference=difference, quantity=name[0].upper() + name[1:], limit=limit),
            title=title,
            ax=ax,
            **options,
        )
        for ax, part, name, limit, title in zip(
            figure.subplots(1, 2), (image.real, image.imag), names, limits, titles, strict=True
        )
    )
    return first, second
