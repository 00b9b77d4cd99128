"""Plot contacts over the image in which they were found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from jeit.arguments import check_kind
from jeit.electrodes import AbstractElectrodes
from jeit.mesh import Mesh
from jeit.plot.axes import INK, axes_or_new
from jeit.plot.colour_scale import CHANGE, ColourScale
from jeit.plot.imaging.image import plot_image
from jeit.touch.contacts import Contact

_HALO = [withStroke(linewidth=3, foreground="white")]


def plot_contacts(
    mesh: Mesh,
    image: ArrayLike,
    contacts: Sequence[Contact],
    electrodes: AbstractElectrodes | None = None,
    *,
    scale: ColourScale = CHANGE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw an image (m,) with the outline of every contact, a cross at its centroid, and the centroid in millimetres.

    Arguments as in `plot_image`. Raises `ValueError` as it does, and for what are no contacts.
    """
    check_contacts(contacts)
    ax = plot_image(mesh, image, electrodes, scale=scale, title=title, ax=ax)
    return draw_contacts(contacts, ax=ax)


def draw_contacts(contacts: Sequence[Contact], *, ax: Axes | None = None) -> Axes:
    """Draw outlines, centroids and coordinates of contacts, on axes in metres. Raises `ValueError` for what are no
    contacts."""
    check_contacts(contacts)
    ax = axes_or_new(ax)
    for contact in contacts:
        x, y = contact.centroid
        ax.add_patch(Polygon(contact.contour, fill=False, edgecolor=INK, linewidth=1.2, zorder=3))
        ax.plot(x, y, marker="+", color=INK, markersize=9, markeredgewidth=1.4, zorder=4, path_effects=_HALO)
        text = f"({1e3 * x:+.1f}, {1e3 * y:+.1f}) mm".replace("-", "−")
        top = contact.contour[:, 1].max()
        ax.annotate(
            text,
            (x, top),
            (0, 4),
            textcoords="offset points",
            ha="center",
            color=INK,
            fontsize=8,
            zorder=5,
            path_effects=_HALO,
        )
    return ax


def check_contacts(contacts) -> None:
    """Check that these are contacts. Raises `ValueError` for what are no contacts."""
    check_kind("contacts", contacts, (list, tuple), "a list of contacts, as of find_contacts(finder, image)")
    for number, contact in enumerate(contacts):
        check_kind(f"contacts[{number}]", contact, Contact, "a Contact")


def largest(values: np.ndarray) -> float:
    """The greatest magnitude of the finite values; 0 if there are none."""
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
