"""The picture of the figures of merit: its plots, units and refused input."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from jeit.image.rasters import FiguresOfMerit
from jeit.plot import plot_figures_of_merit


def merit(error):
    """Figures of targets at 0, 20, 20 and 40 mm in a body of 100 mm radius; the last one does not appear in the
    image."""
    distance = jnp.array([0.0, 0.02, 0.02, 0.04])
    value = jnp.array([0.1, 0.2, 0.4, jnp.nan])
    return FiguresOfMerit(jnp.ones(4), error * jnp.ones(4), value, value, value, distance, jnp.full(4, 0.1))


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def test_five_plots_in_readable_units(ax):
    assert plot_figures_of_merit({"NOSER": merit(1e-3), "GREIT": merit(-2e-3)}, ax=ax) is ax
    titles = [panel.get_title(loc="left") for panel in ax.child_axes]
    assert titles == ["Amplitude response", "Position error", "Resolution", "Shape deformation", "Ringing"]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["NOSER", "GREIT", "perfect image"]
    _, error, resolution, _, _ = ax.child_axes
    assert error.get_ylabel().startswith("mm")
    np.testing.assert_allclose([line.get_ydata()[0] for line in error.lines[1:]], [1, 1, -2, -2])
    mean, dots = resolution.lines[:2]
    np.testing.assert_allclose(mean.get_xdata(), [0, 20])
    np.testing.assert_allclose(mean.get_ydata(), [10, 30])
    np.testing.assert_allclose(dots.get_xydata(), [[0, 10], [20, 20], [20, 40]])
    assert resolution.get_xlim() == (0, 100)
    ax.figure.canvas.draw()


@pytest.mark.parametrize(
    "figures", [{}, {str(k): None for k in range(7)}, {"one": FiguresOfMerit(*[jnp.zeros(())] * 7)}, {"image": [1.0]}]
)
def test_bad_input(figures):
    with pytest.raises(ValueError, match="figures"):
        plot_figures_of_merit(figures)
