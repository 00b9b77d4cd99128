"""Pictures of unrolled surfaces show values, electrodes and marks at their places, and state the distortion."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.patches import Circle

from jeit.design.plots.unrolled_skin import plot_unrolled
from jeit.electrodes import SurfaceDiscs
from jeit.mesh import tube, unroll
from jeit.mesh.geodesic import Unrolled

RADIUS, HEIGHT = 0.03, 0.08
ANGLE = np.array([-1.0, 0.0, 1.5])
PLACES = np.column_stack([RADIUS * np.cos(ANGLE), RADIUS * np.sin(ANGLE), [0.02, 0.04, 0.06]])


@pytest.fixture(scope="module")
def sleeve() -> Unrolled:
    return unroll(tube(RADIUS, HEIGHT, num_around=40))


def circles(ax) -> np.ndarray:
    return np.array([(*patch.center, patch.radius) for patch in ax.patches if isinstance(patch, Circle)])


def test_electrodes_and_marks_are_drawn_at_their_distances_along_the_surface(sleeve):
    discs = SurfaceDiscs(PLACES, 0.004, 1e-4)
    marked = plot_unrolled(sleeve, np.arange(len(sleeve.cells)), discs, marks={"touch": PLACES[0]}, title="Sleeve")
    drawn = circles(marked)
    np.testing.assert_allclose(drawn[:, 2], 0.004)
    np.testing.assert_allclose(np.diff(drawn[:, 1]), 0.02, atol=1e-4)
    np.testing.assert_allclose(np.abs(np.diff(drawn[:, 0])), RADIUS * np.diff(ANGLE), rtol=1e-2)
    assert [text.get_text() for text in marked.texts if text.get_text() in "123"] == ["1", "2", "3"]
    (legend,) = [text.get_text() for text in marked.get_legend().get_texts()]  # pyright: ignore
    assert (marked.get_title(), legend) == ("Sleeve", "touch")
    x, y = next(line.get_xydata() for line in marked.lines if line.get_label() == "touch")[0]
    np.testing.assert_allclose((x, y), drawn[0, :2])
    assert not any("lengths off" in text.get_text() for text in marked.texts)
    plt.close(marked.figure)


def test_values_of_nodes_are_interpolated_and_the_distortion_is_stated(sleeve):
    stretched = Unrolled(sleeve.surface, sleeve.cells, sleeve.points, sleeve.nodes, sleeve.stretch * 1.02)
    ax = plot_unrolled(stretched, np.arange(len(sleeve.surface.points)))
    assert any("lengths off by 2 % on average, 2 % at most" in text.get_text() for text in ax.texts)
    assert ax.get_legend() is None
    plt.close(ax.figure)


def test_values_that_do_not_fit_the_surface_are_refused(sleeve):
    num_triangles, num_nodes = len(sleeve.cells), len(sleeve.surface.points)
    for shape in ((3,), (num_triangles + 1,), (num_nodes, 1), ()):
        with pytest.raises(ValueError, match=f"one for each of the {num_triangles} triangles or the {num_nodes} nodes"):
            plot_unrolled(sleeve, np.zeros(shape))
    with pytest.raises(ValueError, match="real or imaginary part"):
        plot_unrolled(sleeve, np.zeros(len(sleeve.cells), complex))
    with pytest.raises(ValueError, match="electrodes"):
        plot_unrolled(sleeve, electrodes="ring")  # pyright: ignore[reportArgumentType]
