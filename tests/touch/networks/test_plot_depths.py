"""Figures of depth maps and of training."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from jeit.touch.plots import plot_depth_map, plot_losses
from jeit.touch.training import TrainingResult
from jeit.touch.training.model_file import Course

EXTENT = (-0.05, 0.05, -0.04, 0.04)


@pytest.fixture
def ax():
    return Figure().subplots()


def test_a_map_is_drawn_at_the_position_of_the_skin(ax):
    """In millimetres of depth, with the first row at the smallest y."""
    depth = np.zeros((8, 10))
    depth[0, 9] = 3e-3
    plot_depth_map(depth, EXTENT, title="one", ax=ax)
    (drawn,) = ax.images
    assert drawn.origin == "lower"
    assert np.allclose(drawn.get_extent(), EXTENT)
    assert drawn.get_array()[0, 9] == pytest.approx(3.0)
    assert drawn.get_clim() == (0, pytest.approx(3.0))


def test_losses(ax):
    """Relative to the initial losses, with a mark at the best."""
    course = Course([10, 20, 30], [1.0, 0.5, 0.2], [2.0, 0.8, 0.9])
    plot_losses({"maps": TrainingResult(None, course, "done")}, ax=ax)
    line, mark = ax.lines
    assert np.allclose(line.get_ydata(), [1.0, 0.4, 0.45])
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == (20, 0.4)


def test_bad_maps(ax):
    with pytest.raises(ValueError, match=r"depth must be a map \(rows, columns\); it has shape \(3,\)"):
        plot_depth_map(np.zeros(3), EXTENT, ax=ax)
    with pytest.raises(ValueError, match="courses must be trainings by name"):
        plot_losses([], ax=ax)
    with pytest.raises(ValueError, match=r"courses\['a'\] must be a TrainingResult"):
        plot_losses({"a": 3}, ax=ax)
