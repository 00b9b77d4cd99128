"""Surfaces and solids in space, judged by what was drawn: order, colours, places."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from jeit.plot import Camera, plot_surface
from jeit.plot.solid.scene import Scene


@pytest.fixture
def ax():
    return Figure(layout="constrained").subplots()


def pieces(ax) -> PolyCollection:
    (drawn,) = [one for one in ax.collections if isinstance(one, PolyCollection)]
    return drawn


@pytest.mark.parametrize(
    ("angles", "toward", "right", "up"),
    [
        ((-90, 0), (0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((-90, 90), (0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ],
)
def test_cameras_look_where_they_are_told(angles, toward, right, up):
    camera = Camera(*angles)
    for seen, wanted in ((camera.toward, toward), (camera.right, right), (camera.up, up)):
        np.testing.assert_allclose(seen, wanted, atol=1e-15)


def test_what_is_nearer_is_drawn_later(ax):
    points = np.array([[0, 0, z] for z in (0.3, 0.1, 0.2)])[:, None] + [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    scene = Scene(Camera(0, 90))
    for k, colour in enumerate(np.eye(3)):
        scene.add_triangles(points[k], np.array([[0, 1, 2]]), np.array([[*colour, 1.0]]), lit=False)
    scene.draw(ax)
    np.testing.assert_allclose(pieces(ax).get_facecolor()[:, :3], np.eye(3)[[1, 2, 0]])


def test_lengths_across_the_view_are_true(ax):
    camera = Camera(33, 47)
    ends = np.stack([np.zeros(3), 0.05 * camera.up])
    np.testing.assert_allclose(camera.on_page(ends)[1], [0, 0.05], atol=1e-15)


def test_values_become_colours_and_the_light_does_not_change_which(ax):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.2]])
    plot_surface(points, [[0, 1, 2], [1, 3, 2]], [2e-3, -2e-3], ax=ax)
    red, blue = sorted(pieces(ax).get_facecolor(), key=lambda colour: colour[2])
    assert red[0] > 2 * red[2]
    assert blue[2] > 2 * blue[0]
    assert ax.figure.axes[-1].get_ylabel() == "Change of sheet conductivity (mS)"


def test_both_sides_are_lit_alike():
    camera = Camera()
    normals = np.random.default_rng(1).normal(size=(50, 3))
    np.testing.assert_allclose(camera.light(normals), camera.light(-3 * normals))
    assert camera.light(normals).max() <= 1


def test_a_surface_without_values_has_no_colour_bar(ax):
    plot_surface(np.eye(3), [[0, 1, 2]], title="shell", ax=ax)
    assert len(ax.figure.axes) == 1
    assert ax.get_title() == "shell"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((np.zeros((3, 2)), [[0, 1, 2]]), "points has shape"),
        ((np.full((3, 3), np.nan), [[0, 1, 2]]), "points must be finite"),
        ((np.eye(3), [[0, 1, 3]]), "names point 3"),
        ((np.eye(3), np.zeros((0, 3), int)), "triangles has shape"),
        ((np.eye(3), [[0, 1, 2]], [1.0, 2.0]), "values has shape"),
        ((np.eye(3), [[0, 1, 2]], [1j]), "complex"),
        ((np.eye(3), [[0, 1, 2]], [np.inf]), "finite"),
    ],
)
def test_surfaces_that_cannot_be(arguments, said):
    with pytest.raises(ValueError, match=said):
        plot_surface(*arguments)


@pytest.mark.parametrize("angles", [(np.nan, 0), ("left", 0), (0, 91)])
def test_cameras_that_cannot_be(angles):
    with pytest.raises(ValueError, match=r"azimuth|elevation"):
        Camera(*angles)


def test_scales_and_cameras_of_another_kind():
    with pytest.raises(ValueError, match="camera must be a Camera"):
        plot_surface(np.eye(3), [[0, 1, 2]], camera=30)
    with pytest.raises(ValueError, match="scale must be"):
        plot_surface(np.eye(3), [[0, 1, 2]], scale="viridis")
