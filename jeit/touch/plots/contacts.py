"""Plots of contacts on an image, and of the steps by which `RasterFinder` finds contacts."""

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
from jeit.plot.axes import draw_scale_bar, get_or_create_axes, hide_axes
from jeit.plot.colours import CHANGE_SCALE, DARK_GREY, ColourScale, choose_si_prefix, draw_colour_bar
from jeit.plot.imaging.image import plot_image
from jeit.touch.contacts import Contact, RasterStages

_WHITE_HALO = [withStroke(linewidth=3, foreground="white")]


def plot_contacts(
    mesh: Mesh,
    image: ArrayLike,
    contacts: Sequence[Contact],
    electrodes: AbstractElectrodes | None = None,
    *,
    scale: ColourScale = CHANGE_SCALE,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw an image with the outline of every contact, a cross at its centroid, and the coordinates of the centroid in
    millimetres.

    **Arguments:**

    - `mesh`: mesh of the image.
    - `image`: change of conductivity (m,) in every cell, S (3-D: S/m).
    - `contacts`: contacts, as returned by `find_contacts`.
    - `electrodes`: electrodes to be drawn.
    - `scale`: mapping from values of the image to colours.
    - `title`: title of the plot.
    - `ax`: axes to draw into; by default new axes.

    Raises `ValueError` as `jeit.plot.plot_image`, and for elements of `contacts` that are not contacts.

    **Example:**

    ```python
    ax = plot_contacts(model.mesh, image, find_contacts(finder, image, noise), model.electrodes)
    ax.figure.savefig("contacts.png")
    ```
    """
    check_contacts(contacts)
    ax = plot_image(mesh, image, electrodes, scale=scale, title=title, ax=ax)
    return draw_contacts(contacts, ax=ax)


def draw_contacts(contacts: Sequence[Contact], *, ax: Axes | None = None) -> Axes:
    """Draw outlines, centroids and coordinates of contacts, on axes in metres. Raises `ValueError` for elements of
    `contacts` that are not contacts."""
    check_contacts(contacts)
    ax = get_or_create_axes(ax)
    for contact in contacts:
        x, y = contact.centroid
        ax.add_patch(Polygon(contact.contour, fill=False, edgecolor=DARK_GREY, linewidth=1.2, zorder=3))
        ax.plot(
            x, y, marker="+", color=DARK_GREY, markersize=9, markeredgewidth=1.4, zorder=4, path_effects=_WHITE_HALO
        )
        coordinates_text = f"({1e3 * x:+.1f}, {1e3 * y:+.1f}) mm".replace("-", "−")
        contour_top = contact.contour[:, 1].max()
        ax.annotate(
            coordinates_text,
            (x, contour_top),
            (0, 4),
            textcoords="offset points",
            ha="center",
            color=DARK_GREY,
            fontsize=8,
            zorder=5,
            path_effects=_WHITE_HALO,
        )
    return ax


def check_contacts(contacts) -> None:
    """Check that `contacts` is a list of contacts. Raises `ValueError` otherwise."""
    check_kind("contacts", contacts, (list, tuple), "a list of contacts, as of find_contacts(finder, image)")
    for contact_index, contact in enumerate(contacts):
        check_kind(f"contacts[{contact_index}]", contact, Contact, "a Contact")


def largest_magnitude(values: np.ndarray) -> float:
    """Return the maximum magnitude of the finite values of an array; 0 without finite values."""
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


_STAGE_TITLES = ("region of interest", "grey", "adaptive threshold", "opened", "contours", "centroids")


def plot_contact_stages(stages: RasterStages, *, unit: str = "S", axes: np.ndarray | None = None) -> np.ndarray:
    """Draw the results of the steps by which `RasterFinder` finds contacts in an image.

    Six axes show the region of interest, grey levels, threshold, opened mask, contours, and centroids in millimetres.

    **Arguments:**

    - `stages`: result of `RasterFinder.stages`.
    - `unit`: unit of the image.
    - `axes`: six axes to draw on; by default those of a new figure.

    Raises `ValueError` if `stages` is not a result of `RasterFinder.stages`, and for a number of axes other than six.

    **Example:**

    ```python
    stages = RasterFinder(model.mesh).stages(image, noise)
    axes = plot_contact_stages(stages)
    ```
    """
    check_kind("stages", stages, RasterStages, "what finder.stages(image, noise) of a RasterFinder gives")
    axes = _new_axes() if axes is None else np.asarray(axes, object).ravel()
    if axes.size != len(_STAGE_TITLES):
        raise ValueError(f"axes: give six, one for each stage; there are {axes.size}.")
    is_on_skin = np.isfinite(stages.region)
    unit_factor, prefixed_unit = choose_si_prefix(largest_magnitude(stages.region), unit)
    colour_limit = unit_factor * largest_magnitude(stages.region) or 1.0
    colour_options = {"cmap": "RdBu_r", "vmin": -colour_limit, "vmax": colour_limit}
    region_image = _draw_pixels(axes[0], unit_factor * stages.region, stages, colour_options)
    # The colour bar is as tall as its image, whatever the height of the axes.
    colour_bar_axes = axes[0].inset_axes((1.02, 0.1, 0.035, 0.8))
    draw_colour_bar(axes[0], region_image, f"Change ({prefixed_unit})", show_sign=True, position=colour_bar_axes)
    grey_options = {"cmap": "gray", "vmin": 0, "vmax": 255}
    grey_images = (stages.grey, 255.0 * stages.threshold, 255.0 * stages.opened, stages.grey)
    for ax, grey_pixels in zip(axes[1:5], grey_images, strict=True):
        _draw_pixels(ax, np.where(is_on_skin, grey_pixels, np.nan), stages, grey_options)
    for contact in stages.contacts:
        closed_contour = np.vstack([contact.contour, contact.contour[:1]])
        axes[4].plot(*closed_contour.T, color="#d1495b", linewidth=1.4)
    _draw_pixels(axes[5], unit_factor * stages.region, stages, colour_options)
    draw_contacts(stages.contacts, ax=axes[5])
    for ax, stage_title in zip(axes, _STAGE_TITLES, strict=True):
        hide_axes(ax, stages.extent, numbered=False)
        ax.set_title(stage_title, fontsize=10)
        draw_scale_bar(ax, stages.extent)
    return axes


def _draw_pixels(ax: Axes, pixels: np.ndarray, stages: RasterStages, image_options: dict):
    return ax.imshow(pixels, extent=stages.extent, interpolation="nearest", **image_options)


def _new_axes() -> np.ndarray:
    from matplotlib import pyplot

    return pyplot.subplots(2, 3, figsize=(11, 7.4), layout="constrained")[1].ravel()
