"""Figures of contacts: the drawn content and its position."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from jeit.mesh import centroids, disk
from jeit.touch.contacts import CellFinder, ImageNoise, RasterFinder, find_contacts
from jeit.touch.plots import plot_contact_stages, plot_contacts

MESH = disk(0.05, num_points=700)
QUIET = ImageNoise(np.full(MESH.num_cells, 1e-9))


@pytest.fixture(scope="module")
def image():
    """Of two contacts, on a disk."""
    near = [np.linalg.norm(np.asarray(centroids(MESH)) - place, axis=1) for place in ((0.025, 0.0), (-0.02, 0.01))]
    return 1e-6 * sum(height * np.exp(-((one / 0.01) ** 2)) for height, one in zip((1.0, 2.0), near, strict=True))


def test_contacts_are_drawn_at_their_places(image):
    found = find_contacts(CellFinder(MESH), image, QUIET)
    ax = plot_contacts(MESH, image, found, ax=Figure().subplots())
    outlines = [one.get_xy()[:-1] for one in ax.patches if isinstance(one, Polygon)]
    assert len(outlines) == 2
    for outline, contact in zip(outlines, found, strict=True):
        np.testing.assert_allclose(outline, contact.contour)
    texts = [text.get_text() for text in ax.texts]
    assert sum("mm" in text for text in texts) == 3  # two places and the scale bar
    places = [1e3 * one.centroid for one in found]
    assert [f"({x:+.1f}, {y:+.1f}) mm".replace("-", "−") for x, y in places] == texts[-2:]


def test_every_stage_has_its_axes(image):
    stages = RasterFinder(MESH).stages(image, QUIET)
    axes = plot_contact_stages(stages, axes=Figure(layout="constrained").subplots(2, 3))
    titles = [ax.get_title() for ax in axes]
    assert titles == ["region of interest", "grey", "adaptive threshold", "opened", "contours", "centroids"]
    shown = np.ma.filled(axes[2].images[0].get_array(), 0)
    np.testing.assert_array_equal(shown > 0, stages.threshold)
    assert all(any(text.get_text() == "20 mm" for text in ax.texts) for ax in axes)
    (bar,) = axes[0].child_axes
    axes[0].figure.draw_without_rendering()
    assert bar.get_window_extent().height < axes[0].get_window_extent().height
    assert len([line for line in axes[4].lines if len(line.get_xdata()) > 10]) == 2
    assert "µS)" in bar.get_ylabel() or "nS)" in bar.get_ylabel()


def test_bad_arguments(image):
    with pytest.raises(ValueError, match="contacts must be"):
        plot_contacts(MESH, image, 3)
    with pytest.raises(ValueError, match=r"contacts\[0\] must be"):
        plot_contacts(MESH, image, [3])
    with pytest.raises(ValueError, match="stages must be"):
        plot_contact_stages(image)
    stages = RasterFinder(MESH).stages(image, QUIET)
    with pytest.raises(ValueError, match="axes: give six"):
        plot_contact_stages(stages, axes=Figure().subplots(1, 2))
