"""Pictures of contacts: what is drawn, where."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from jeit.plot import plot_contact_stages, plot_contacts
from jeit.touch.contacts import CellFinder, RasterFinder, find_contacts


def test_contacts_are_drawn_where_they_are(skin):
    found = find_contacts(CellFinder(skin.mesh), skin.two, skin.noise)
    ax = plot_contacts(skin.mesh, skin.two, found, ax=Figure().subplots())
    outlines = [one.get_xy()[:-1] for one in ax.patches if isinstance(one, Polygon)]
    assert len(outlines) == 2
    for outline, contact in zip(outlines, found, strict=True):
        np.testing.assert_allclose(outline, contact.contour)
    texts = [text.get_text() for text in ax.texts]
    assert sum("mm" in text for text in texts) == 3  # two places and the scale bar
    assert f"({1e3 * found[0].centroid[0]:+.1f}".replace("-", "−") in " ".join(texts)


def test_every_stage_has_its_axes(skin):
    stages = RasterFinder(skin.mesh).stages(skin.two, skin.noise)
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


def test_things_of_another_kind(skin):
    with pytest.raises(ValueError, match="contacts must be"):
        plot_contacts(skin.mesh, skin.two, 3)
    with pytest.raises(ValueError, match=r"contacts\[0\] must be"):
        plot_contacts(skin.mesh, skin.two, [3])
    with pytest.raises(ValueError, match="stages must be"):
        plot_contact_stages(skin.two)
    stages = RasterFinder(skin.mesh).stages(skin.two, skin.noise)
    with pytest.raises(ValueError, match="axes: give six"):
        plot_contact_stages(stages, axes=Figure().subplots(1, 2))
