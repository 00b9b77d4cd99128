"""Plot every step of finding contacts in an image, side by side."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from jeit.arguments import check_kind
from jeit.plot.axes import bare, draw_colour_bar, draw_scale_bar, prefixed
from jeit.touch.contacts import RasterStages
from jeit.touch.plots.contacts import draw_contacts, largest

_TITLES = ("region of interest", "grey", "adaptive threshold", "opened", "contours", "centroids")


def plot_contact_stages(stages: RasterStages, *, unit: str = "S", axes: np.ndarray | None = None) -> np.ndarray:
    """Draw the result of every step of `RasterFinder` on six axes.

    They are the region of interest with its unit, grey levels, threshold, opened mask, contours, and centroids in
    millimetres over the region. `stages`: `finder.stages(image, noise)`; `unit`: the unit of the image; `axes` (6,) to
    draw on, those of a new figure unless given. Raises `ValueError` for what are no stages, and another number of axes.
    """
    check_kind("stages", stages, RasterStages, "what finder.stages(image, noise) of a RasterFinder gives")
    axes = _six() if axes is None else np.asarray(axes, object).ravel()
    if axes.size != len(_TITLES):
        raise ValueError(f"axes: give six, one for each stage; there are {axes.size}.")
    inside = np.isfinite(stages.region)
    factor, with_prefix = prefixed(largest(stages.region), unit)
    strongest = factor * largest(stages.region) or 1.0
    keywords = {"cmap": "RdBu_r", "vmin": -strongest, "vmax": strongest}
    region = _drawn(axes[0], factor * stages.region, stages, keywords)
    # No taller than its image, however tall the axes are that the six images share.
    bar = axes[0].inset_axes((1.02, 0.1, 0.035, 0.8))
    draw_colour_bar(axes[0], region, f"Change ({with_prefix})", signed=True, place=bar)
    black = {"cmap": "gray", "vmin": 0, "vmax": 255}
    greys = (stages.grey, 255.0 * stages.threshold, 255.0 * stages.opened, stages.grey)
    for ax, pixels in zip(axes[1:5], greys, strict=True):
        _drawn(ax, np.where(inside, pixels, np.nan), stages, black)
    for contact in stages.contacts:
        closed = np.vstack([contact.contour, contact.contour[:1]])
        axes[4].plot(*closed.T, color="#d1495b", linewidth=1.4)
    _drawn(axes[5], factor * stages.region, stages, keywords)
    draw_contacts(stages.contacts, ax=axes[5])
    for ax, title in zip(axes, _TITLES, strict=True):
        bare(ax, stages.extent, numbered=False)
        ax.set_title(title, fontsize=10)
        draw_scale_bar(ax, stages.extent)
    return axes


def _drawn(ax: Axes, pixels: np.ndarray, stages: RasterStages, keywords: dict):
    return ax.imshow(pixels, extent=stages.extent, interpolation="nearest", **keywords)


def _six() -> np.ndarray:
    from matplotlib import pyplot

    return pyplot.subplots(2, 3, figsize=(11, 7.4), layout="constrained")[1].ravel()
