"""Figures of virtual taxels, tested on what was drawn: cells, colours, outlines, areas, units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch
from matplotlib.tri import TriContourSet

from jeit.design import touch_grid
from jeit.design.plots import plot_sensitivity_histograms, plot_taxel_areas, plot_taxels
from jeit.design.plots.responses import plot_similarity
from jeit.design.sensitivity import SensitivityMap
from jeit.design.taxels import Taxels
from jeit.layout import grid
from jeit.mesh import Rectangle
from jeit_solvers import KMeans

ELECTRODES = grid(0.08, 0.08, 2, 2)


def four(columns=8, rows=8, places=None):
    """Four taxels in the quarters of a square of 100 mm, of 9 to 36 cm². The last has no cell and no area."""
    if places is None:
        places = grid(0.1 * (1 - 1 / columns), 0.1 * (1 - 1 / rows), columns, rows)
    count = len(places)
    labels = (places[:, 0] > 0) + 2 * (places[:, 1] > 0)
    middles = np.array([[-0.025, -0.025], [0.025, -0.025], [-0.025, 0.025], [0.025, 0.025]])
    off = np.abs(places - middles[:, None]).max(axis=2)
    similarity = 1 - off / np.array([[0.1], [0.12], [0.16], [0.1]])
    similarity[3] = -0.2
    clusters = KMeans(jnp.eye(4), jnp.asarray(labels), jnp.zeros(()), jnp.ones((), int), jnp.ones((), bool))
    area = jnp.full(count, 0.01 / count)
    return Taxels(jnp.asarray(places), area, clusters, jnp.asarray(similarity), 0.7)


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def cells_of(ax):
    (cells,) = [c for c in ax.collections if isinstance(c, PolyCollection)]
    return cells


def box_of(path):
    return np.concatenate([path.vertices.min(axis=0), path.vertices.max(axis=0)])


def outlines(ax):
    return [c for c in ax.collections if isinstance(c, TriContourSet)]


def texts(ax):
    return [text.get_text() for text in ax.texts]


def test_cells_have_the_area_of_their_taxel(ax):
    taxels = four()
    assert plot_taxels(taxels, electrodes=ELECTRODES, title="Inside", ax=ax) is ax
    cells = cells_of(ax)
    expected = 1e4 * np.asarray(taxels.areas)
    assert len(set(expected)) == 4
    np.testing.assert_allclose(cells.get_array(), expected[np.asarray(taxels.labels)])
    assert cells.get_clim() == pytest.approx((0, expected.max()))
    paths = cells.get_paths()
    assert len(paths) == 64
    np.testing.assert_allclose(box_of(paths[0]), [-0.05, -0.05, -0.0375, -0.0375])
    np.testing.assert_allclose(box_of(paths[-1]), [0.0375, 0.0375, 0.05, 0.05])
    np.testing.assert_allclose(ax.lines[0].get_xydata(), ELECTRODES)
    assert ax.figure.axes[-1].get_ylabel() == "Taxel area (cm²)"
    assert ax.get_title() == "Inside"
    assert "20 mm" in texts(ax)
    assert not outlines(ax)


def test_two_layouts_can_share_a_scale(ax):
    plot_taxels(four(), limit=50e-4, ax=ax)
    assert cells_of(ax).get_clim() == pytest.approx((0, 50))


def test_coverage_is_counted(ax):
    taxels = four()
    plot_taxels(taxels, colour="coverage", electrodes=np.column_stack([ELECTRODES, np.ones(4)]), ax=ax)
    np.testing.assert_array_equal(cells_of(ax).get_array(), taxels.coverage)
    assert ax.figure.axes[-1].get_ylabel() == "Taxels over a point"


def test_adjacent_taxels_have_different_colours(ax):
    taxels = four()
    plot_taxels(taxels, colour="label", outlines=True, ax=ax)
    colour, labels = np.asarray(cells_of(ax).get_array()), np.asarray(taxels.labels)
    of_cluster = [set(colour[labels == index]) for index in range(4)]
    assert all(len(one) == 1 for one in of_cluster)
    assert of_cluster[0] != of_cluster[1] != of_cluster[3] != of_cluster[2] != of_cluster[0]
    assert len(ax.figure.axes) == 1  # labels need no colour bar
    # The taxel without cells has no outline.
    assert len(outlines(ax)) == 3


@pytest.mark.parametrize(("columns", "rows", "sides"), [(4, 10, (0.025, 0.01)), (5, 5, (0.02, 0.02))])
def test_cells_of_a_grid_fill_it(columns, rows, sides, ax):
    plot_taxels(four(columns, rows), ax=ax)
    for path in cells_of(ax).get_paths():
        left, bottom, right, top = box_of(path)
        assert (right - left, top - bottom) == pytest.approx(sides)


def test_cells_of_scattered_places_are_squares(ax):
    taxels = four(places=np.random.default_rng(0).uniform(-0.05, 0.05, (50, 2)))
    plot_taxels(taxels, ax=ax)
    for path, place in zip(cells_of(ax).get_paths(), np.asarray(taxels.places), strict=True):
        left, bottom, right, top = box_of(path)
        assert (right - left, top - bottom) == pytest.approx(2 * (np.sqrt(0.01 / 50),))
        assert ((left + right) / 2, (bottom + top) / 2) == pytest.approx(tuple(place))


def test_a_similarity_surface_has_the_outline_of_its_taxel(ax):
    taxels = four(columns=20, rows=20)
    assert plot_similarity(taxels, 1, electrodes=ELECTRODES, ax=ax) is ax
    cells = cells_of(ax)
    np.testing.assert_allclose(cells.get_array(), taxels.similarity[1])
    assert cells.get_clim() == (0, 1)
    (outline,) = outlines(ax)
    # 0.3 · 120 mm to all sides of the centre, as far as the skin extends.
    x, y = outline.get_paths()[0].vertices.T
    assert (x.min(), y.max()) == pytest.approx((0.025 - 0.036, -0.025 + 0.036), abs=1e-3)
    assert ax.get_title() == f"{1e4 * float(taxels.areas[1]):.1f} cm²"
    assert ax.figure.axes[-1].get_ylabel() == "Cosine similarity"
    assert "20 mm" in texts(ax)


def test_a_taxel_without_cells_can_be_drawn(ax):
    plot_similarity(four(), 3, colour_bar=False, ax=ax)
    assert not outlines(ax)
    assert ax.get_title() == "0.0 cm²"
    assert len(ax.figure.axes) == 1


def test_legends_of_histograms_are_above_them(ax):
    """Above the tallest bar too, wherever it is."""
    one = four()
    plot_taxel_areas({"inside": one, "a layout of a long name that reaches far to the left": one}, bins=4, ax=ax)
    ax.figure.draw_without_rendering()
    box = ax.get_legend().get_window_extent().transformed(ax.transData.inverted())
    assert box.y0 > max(patch.get_path().vertices[:, 1].max() for patch in ax.patches)


def test_the_line_in_histograms_of_sensitivity_has_a_label(ax):
    places = touch_grid(Rectangle(0.1, 0.1), 4, 4)
    maps = {
        name: SensitivityMap(places, scale * jnp.arange(1.0, 17.0)[:, None])
        for name, scale in (("a", 1e-3), ("b", 2e-3))
    }
    plot_sensitivity_histograms(maps, ax=ax)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["a", "b", "least of a"]
    np.testing.assert_allclose(ax.lines[0].get_xdata(), 1.0)  # mV
    assert not ax.spines["top"].get_visible()


def test_histograms_share_their_bins(ax):
    one, other = four(), four(places=grid(0.05, 0.05, 8, 8))
    assert plot_taxel_areas({"inside": one, "boundary": other}, bins=7, ax=ax) is ax
    filled, line, _, other_line = [patch for patch in ax.patches if isinstance(patch, StepPatch)]
    areas = 1e4 * np.asarray(one.areas)
    most = 1e4 * max(float(one.max_area), float(other.max_area))
    counts, edges, _ = line.get_data()
    np.testing.assert_allclose(edges, np.linspace(0, most, 8))
    np.testing.assert_array_equal(counts, np.histogram(areas, edges)[0])
    np.testing.assert_allclose(other_line.get_data().edges, edges)
    assert filled.get_fill()
    assert counts.sum() == 4
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert names[0] == f"inside: {areas.mean():.1f} ± {areas.std():.1f} cm²"
    assert names[1].startswith("boundary: ")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Taxel area (cm²)", "Taxels")


@pytest.mark.parametrize(
    ("match", "draw"),
    [
        ("colour must be one of", lambda one: plot_taxels(one, colour="red")),
        ("electrodes has shape", lambda one: plot_taxels(one, electrodes=np.zeros(3))),
        ("index must be from 0 to 3", lambda one: plot_similarity(one, 4)),
        ("index must be from 0 to 3", lambda one: plot_similarity(one, 0.5)),
        ("0 layouts", lambda _: plot_taxel_areas({})),
        ("7 layouts", lambda one: plot_taxel_areas(dict.fromkeys("abcdefg", one))),
    ],
)
def test_refuses_bad_input(match, draw, monkeypatch, ax):
    monkeypatch.setattr("jeit.design.plots.responses.get_or_create_axes", lambda *_: ax)
    with pytest.raises(ValueError, match=match):
        draw(four())


def test_a_batch_is_drawn_one_by_one(ax):
    batch = jax.tree.map(lambda array: jnp.stack([array, array]), four())
    for draw in (plot_taxels, plot_taxel_areas, lambda taxels, ax: plot_similarity(taxels, 0, ax=ax)):
        with pytest.raises(ValueError, match="batch of 2 layouts"):
            draw(batch, ax=ax)


def test_figures_are_created_where_no_axes_are_given():
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    for drawn in (plot_taxels(four(), outlines=True), plot_taxel_areas(four()), plot_similarity(four(), 0)):
        drawn.figure.draw_without_rendering()
        pyplot.close(drawn.figure)
