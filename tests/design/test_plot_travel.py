"""The figure of electrode displacements during optimisation, tested on what was drawn: paths, discs, regions, title."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure

from jeit.design.optimisation.optimise import Optimisation
from jeit.design.plots import plot_travel
from jeit.design.scores import Scores
from jeit.layout import Layout, grid
from jeit.mesh import Disk, Rectangle

SKIN = Rectangle(0.1, 0.1)
BEGAN = grid(0.06, 0.06, 2, 2)
ENDED = BEGAN + np.array([0.003, 0.004])


def optimisation():
    empty, one = jnp.zeros(1), jnp.zeros(())
    snapshots = np.stack([[BEGAN, (BEGAN + ENDED) / 2], [ENDED, ENDED]])
    return Optimisation(
        Layout(ENDED, 6e-3, outline=SKIN),
        Scores(empty, one, empty, one, one, empty),
        value=1.0,
        start_value=0.0,
        centres=np.stack([ENDED, ENDED]),
        radii=np.full((2, 4), 3e-3),
        contact_impedance=np.ones((2, 4)),
        thickness=np.ones(2),
        values=np.ones(2),
        shortfall=np.zeros(2),
        history=np.zeros((2, 2)),
        snapshots=snapshots,
        best=0,
        status="converged",
        reason="",
    )


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def test_paths_lead_from_start_to_end(ax):
    assert plot_travel(optimisation(), ax=ax) is ax
    (ways,) = (one for one in ax.collections if isinstance(one, LineCollection))
    segments = np.array(ways.get_segments())
    assert segments.shape == (4, 3, 2)
    np.testing.assert_allclose(segments[:, 0], BEGAN)
    np.testing.assert_allclose(segments[:, -1], ENDED)
    began, ended = (one for one in ax.collections if isinstance(one, PatchCollection))
    for discs, places in ((began, BEGAN), (ended, ENDED)):
        boxes = [path.get_extents() for path in discs.get_paths()]
        np.testing.assert_allclose([(box.x0 + box.x1) / 2 for box in boxes], places[:, 0], atol=1e-12)
        np.testing.assert_allclose([box.width for box in boxes], 6e-3, rtol=1e-6)
    assert ax.get_title() == "Moved 5 mm on average"
    (scale,) = (text for text in ax.texts if text.get_text().endswith("mm"))
    (bar,) = ax.lines
    assert ax.get_ylim()[0] < min(scale.get_position()[1], bar.get_ydata()[0])


def test_a_legend_names_the_symbols(ax):
    plot_travel(optimisation(), ax=ax)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "where it began", "way, step by step", "where it ended",
    ]  # fmt: skip
    plot_travel(optimisation(), keep_out=(Disk(0.01),), ax=ax)
    assert [text.get_text() for text in ax.get_legend().get_texts()][3:] == ["kept free"]
    # It covers neither the skin nor the scale bar.
    ax.figure.draw_without_rendering()
    box = ax.get_legend().get_window_extent().transformed(ax.transData.inverted())
    assert box.y1 < -0.05
    assert box.x0 > max(line.get_xdata()[1] for line in ax.lines)


def test_regions_are_hatched_and_a_start_can_be_selected(ax):
    plot_travel(optimisation(), 1, keep_out=(Disk(0.01, (0.02, 0.02)),), title="second", ax=ax)
    assert [bool(patch.get_hatch()) for patch in ax.patches] == [False, True]
    box = ax.patches[1].get_path().get_extents()
    np.testing.assert_allclose([box.x0, box.x1], [0.01, 0.03], atol=1e-5)
    assert ax.get_title() == "second"
    with pytest.raises(ValueError, match="start must be from 0 to 1"):
        plot_travel(optimisation(), 2, ax=ax)
