"""Surfaces: charts of planes and of curved skins, against a cylinder, which has exact formulas."""

import jax
import numpy as np
import pytest
from microphone_arrays import OUTLINE

from jeit.acoustic import surface as surfaces
from jeit.acoustic.surface import (
    CurvedSurface,
    Plane,
    bounding_box,
    chart_grid,
    longer_side,
    outline_sides,
    to_three_dimensions,
)
from jeit.mesh import Disk, Polygon, Rectangle
from jeit_solvers.engines import on_device, on_host

RADIUS = 0.15


def make_surface(outline, points=None):
    """Computed in NumPy, without compilation."""
    return on_host(surfaces.make_surface(outline, points))


def on_cylinder(chart):
    """Points (n, 3) of a cylinder about the y axis from its chart (n, 2), with arc length along x."""
    angle = np.asarray(chart)[:, 0] / RADIUS
    return np.stack([RADIUS * np.sin(angle), chart[:, 1], RADIUS * (np.cos(angle) - 1)], axis=1)


def cylinder(number):
    """A segment of 0.2 m by 0.2 m with number² taps on it."""
    along = np.linspace(-0.1, 0.1, 9)
    rim = [(x, -0.1) for x in along] + [(0.1, y) for y in along[1:]]
    rim += [(x, 0.1) for x in along[-2::-1]] + [(-0.1, y) for y in along[-2:0:-1]]
    taps = np.stack(np.meshgrid(*2 * [np.linspace(-0.09, 0.09, number)]), axis=-1).reshape(-1, 2)
    return on_cylinder(np.array(rim)), on_cylinder(taps)


def off_cylinder(points):
    """Distance from the cylinder, metres."""
    return np.abs(np.hypot(points[:, 0], points[:, 2] + RADIUS) - RADIUS)


def turned(points):
    """A rigid motion: three angles and a translation."""
    a, b, c = 0.4, -1.1, 2.3
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    about_y = np.array([[np.cos(c), 0, np.sin(c)], [0, 1, 0], [-np.sin(c), 0, np.cos(c)]])
    return points @ (about_z @ about_x @ about_y).T + np.array([0.5, -0.2, 1.0])


@pytest.fixture(scope="module")
def skin():
    return make_surface(*cylinder(13))


def middle(number=200):
    """Places in the chart, which for this cylinder is (x, y) in space, about the centre of the points."""
    return np.asarray(np.random.default_rng(0).uniform(-0.08, 0.08, (2, number)))


@pytest.mark.parametrize("outline", [OUTLINE, Rectangle(0.2, 0.2), Polygon(OUTLINE)])
def test_the_chart_of_a_plane_is_the_identity(outline):
    plane = make_surface(outline)
    assert isinstance(plane, Plane)
    assert plane.dimension == 2
    np.testing.assert_array_equal(plane.place(middle()), middle())
    np.testing.assert_array_equal(plane.project(middle()), middle())
    np.testing.assert_allclose(np.stack(bounding_box(plane)), [[-0.1, -0.1], [0.1, 0.1]])
    assert float(longer_side(plane)) == pytest.approx(0.2)


def test_a_disk_is_nearly_round():
    plane = make_surface(Disk(0.1))
    angle = np.linspace(0, 2 * np.pi, 1000)
    circle = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.asarray(plane.outline.contains(0.9995 * circle)).all()
    assert not np.asarray(plane.outline.contains(1.0001 * circle)).any()


def test_pixels_fill_the_box_bottom_row_first():
    hole = [[-0.05, -0.05], [-0.05, 0.05], [0.05, 0.05], [0.05, -0.05]]
    grid, within = chart_grid(make_surface(Polygon(OUTLINE, [hole])), 8, 4)
    assert grid.shape == (2, 4, 8)
    np.testing.assert_allclose(grid[0, 0], -0.1 + 0.025 * (np.arange(8) + 0.5))
    np.testing.assert_allclose(grid[1, :, 0], -0.1 + 0.05 * (np.arange(4) + 0.5))
    np.testing.assert_array_equal(within, ~((np.abs(grid[0]) < 0.05) & (np.abs(grid[1]) < 0.05)))


def test_sides_are_those_of_the_outline_and_of_its_holes():
    hole = np.array([[-0.05, -0.02], [-0.05, 0.05], [0.05, 0.05]])
    start, end = outline_sides(make_surface(Polygon(OUTLINE, [hole])))
    assert start.shape == end.shape == (2, 7)
    legs = 0.07 + 0.1 + np.hypot(0.1, 0.07)
    assert float(np.linalg.norm(end - start, axis=0).sum()) == pytest.approx(0.8 + legs, rel=1e-12)
    # Every corner is the end of one side and the start of another.
    assert {tuple(p) for p in np.asarray(start).T} == {tuple(p) for p in np.asarray(end).T}


def test_a_curved_surface_passes_through_its_points():
    rim, taps = cylinder(12)
    skin, known = make_surface(rim, taps), np.vstack([rim, taps])
    assert isinstance(skin, CurvedSurface)
    assert skin.dimension == 3
    again = np.asarray(skin.place(skin.project(np.asarray(known.T)))).T
    # Slight smoothing, 1e-9 of the size squared, is included: less than a micrometre for 0.2 m.
    assert np.linalg.norm(again - known, axis=1).max() < 1e-6


def test_a_place_that_is_tapped_twice_is_no_fold():
    """Two taps at one place, and two at places 10 µm apart."""
    rim, taps = cylinder(5)
    close = on_cylinder(np.array([[0.02, 0.01], [0.02, 0.01 + 1e-5]]))
    known = np.vstack([rim, taps, taps[:1], close])
    skin = make_surface(rim, known[len(rim) :])
    again = np.asarray(skin.place(skin.project(np.asarray(known.T)))).T
    assert np.linalg.norm(again - known, axis=1).max() < 1e-6


def test_an_inclined_surface():
    """It is steep on one side only, so that it deviates from the plane of best fit, and still passes through its
    points.
    """
    along = np.random.default_rng(3).uniform(0, 0.2, (60, 2))
    corners = np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]])
    rim, taps = (np.column_stack([part, 4 * part[:, 0] ** 3 + part[:, 0] * part[:, 1]]) for part in (corners, along))
    surface, known = make_surface(rim, taps), np.vstack([rim, taps])
    again = np.asarray(surface.place(surface.project(np.asarray(known.T)))).T
    assert np.linalg.norm(again - known, axis=1).max() < 1e-6


def test_chart_and_place_are_inverse(skin):
    np.testing.assert_allclose(skin.project(skin.place(middle())), middle(), atol=1e-15)


def test_more_points_are_closer_to_the_exact_surface():
    """Thin-plate splines have errors of the pitch to the power 1.5 at least: at half the pitch, less than 0.35 of the
    error.
    """
    worst = [off_cylinder(np.asarray(make_surface(*cylinder(n)).place(middle())).T).max() for n in (5, 9)]
    assert worst[1] < 0.35 * worst[0]
    assert worst[1] < 5e-5  # of a sagitta of 32 mm


def test_many_points_are_thinned_out():
    """300 of 1,632, some 11 mm apart. The surface nearly passes through those left out."""
    rim, taps = cylinder(40)
    dense, known = make_surface(rim, taps), np.vstack([rim, taps])
    assert len(dense.knots) == 300
    assert off_cylinder(np.asarray(dense.place(middle())).T).max() < 2e-4
    again = np.asarray(dense.place(dense.project(np.asarray(known.T)))).T
    assert np.linalg.norm(again - known, axis=1).max() < 5e-4


def test_a_place_that_was_touched_twice_has_the_mean_height():
    """Two taps at one place whose heights differ by 0.6 mm, and 1 µm apart, as positions measured by hand may be."""
    rim, taps = cylinder(9)
    plain = make_surface(rim, taps)
    again = taps[4] + [1e-6, 0.0, 0.0]
    along = np.array([0.0, 0.0, 6e-4])
    twice = make_surface(rim, np.vstack([taps, again + along / 2, again - along / 2]))
    once = np.asarray(plain.place(plain.project(np.asarray(taps.T)))).T
    repeated = np.asarray(twice.place(twice.project(np.asarray(taps.T)))).T
    assert len(twice.knots) == len(plain.knots)
    np.testing.assert_allclose(repeated, once, atol=2e-5)


def test_the_surface_does_not_depend_on_axes():
    """Rotated and translated with all its points, it is the same surface, at the same distance from the points off
    it.
    """
    rim, taps = cylinder(9)
    plain, moved = make_surface(rim, taps), make_surface(turned(rim), turned(taps))
    place = np.asarray(plain.place(middle())).T
    back = np.asarray(moved.place(moved.project(np.asarray(turned(place).T)))).T
    np.testing.assert_allclose(back, turned(place), atol=1e-8)
    np.testing.assert_allclose(moved.axes.T @ moved.axes, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(moved.normal @ moved.axes, 0, atol=1e-14)


def test_a_plane_in_space_is_a_plane():
    flat = turned(np.column_stack([OUTLINE, np.zeros(4)]))
    surface = make_surface(flat)
    places = np.asarray(surface.place(middle())).T
    normal = np.cross(flat[1] - flat[0], flat[2] - flat[0])
    np.testing.assert_allclose((places - flat[0]) @ normal / np.linalg.norm(normal), 0, atol=1e-12)
    one, other = places[:100], places[100:]
    flat_distance = np.linalg.norm(middle()[:, :100] - middle()[:, 100:], axis=0)
    np.testing.assert_allclose(np.linalg.norm(one - other, axis=1), flat_distance, rtol=1e-9)


def test_slopes_of_a_curved_surface(skin):
    """Second order of the Taylor remainder, at a knot too, and finite everywhere."""
    at = np.concatenate([middle(5), skin.knots[:3].T], axis=1)
    direction = np.random.default_rng(1).normal(size=at.shape)
    covariance = np.broadcast_to(1e-6 * np.eye(2)[..., None], (2, 2, at.shape[1]))

    @jax.jit
    def compiled(at):
        made = on_device(skin)
        return jax.jvp(made.place, (at,), (direction,)), to_three_dimensions(made, at, covariance)

    (place, slope), spread = compiled(at)
    for mine, theirs in zip(
        (place, *spread), (skin.place(at), *to_three_dimensions(skin, at, covariance)), strict=True
    ):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-15)
    rest = [np.abs(skin.place(at + h * direction) - place - h * slope).max() for h in (1e-3, 1e-4)]
    assert np.log10(float(rest[0] / rest[1])) > 1.8
    assert np.isfinite(slope).all()


def test_covariance_in_space(skin):
    """J C Jᵀ, of rank two, with J by differences."""
    chart = middle(4)
    root = np.random.default_rng(2).normal(size=(4, 2, 2)) * 1e-3
    covariance = root @ root.transpose(0, 2, 1)
    place, found = to_three_dimensions(skin, chart, np.asarray(covariance.transpose(1, 2, 0)))
    # The order of summation differs.
    np.testing.assert_allclose(place, skin.place(chart).T, atol=1e-15)
    step = 1e-6
    columns = [
        (skin.place(chart + step * one[:, None]) - skin.place(chart - step * one[:, None])) / (2 * step)
        for one in np.eye(2)
    ]
    jacobian = np.stack(columns, axis=1).transpose(2, 0, 1)
    expected = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)
    assert (np.linalg.eigvalsh(found)[:, 0] < 1e-12 * np.linalg.eigvalsh(found)[:, 2]).all()


def test_any_axes(skin):
    chart = middle(12).reshape(2, 3, 4)
    places = skin.place(chart)
    assert places.shape == (3, 3, 4)
    np.testing.assert_allclose(places[:, 1, 2], skin.place(chart[:, 1, 2]), atol=1e-15)
    np.testing.assert_allclose(skin.project(places), chart, atol=1e-15)


@pytest.mark.parametrize(
    ("outline", "points", "message"),
    [
        (OUTLINE[:2], None, "three vertices"),
        (OUTLINE[0], None, "three vertices"),
        (np.zeros((4, 4)), None, "three vertices"),
        (np.column_stack([np.arange(4.0)] * 3), None, "one line"),
        (np.column_stack([OUTLINE, [0, 0, 0, np.nan]]), None, "finite"),
        (np.column_stack([OUTLINE, np.zeros(4)]), [[0.0, np.inf, 0.0]], "finite"),
        (np.column_stack([OUTLINE, np.zeros(4)]), [[0.0, 0.0, 0.03], [0.0, 1e-5, -0.03]], "folds"),
    ],
)
def test_bad_outlines(outline, points, message):
    with pytest.raises(ValueError, match=message):
        make_surface(outline, points)
