"""Inclusions found in an image, marked: a cross at the centroid in a circle of the same area, or a ball's volume."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from jeit.image import Inclusion
from jeit.plot.axes import INK, axes_or_new


def draw_inclusions(inclusions: Sequence[Inclusion], *, ax: Axes | None = None) -> Axes:
    """Mark every inclusion with its sign at its centroid and a dashed circle: of its area, or in 3-D the equator of the
    ball of its volume, wherever the slice is."""
    ax = axes_or_new(ax)
    halo = [withStroke(linewidth=3, foreground="white")]
    for inclusion in inclusions:
        x, y = inclusion.centroid[:2]
        ax.add_patch(
            Circle((x, y), inclusion.radius, fill=False, edgecolor=INK, linewidth=1.0, linestyle=(0, (4, 3)), zorder=3)
        )
        marker = "+" if inclusion.sign > 0 else "_"
        ax.plot(x, y, marker=marker, color=INK, markersize=9, markeredgewidth=1.4, zorder=4, path_effects=halo)
    return ax
