"""Sensitivity maps: their definition, and the symmetry of the skin."""

import numpy as np
import pytest
from studies import linear_changes

from jeit.design import Bell, Hemisphere, touch_grid
from jeit.design.sensitivity import SensitivityMap
from jeit.design.skin.touched_cells import touched_cells
from jeit.electrodes import SheetDiscs
from jeit.forward import ForwardModel
from jeit.layout import grid
from jeit.mesh import Disk, Polygon, Rectangle, rectangle
from jeit.protocol import adjacent


@pytest.fixture(scope="module")
def theta():
    mesh = rectangle(0.1, 0.1, cell_size=0.008)
    model = ForwardModel(mesh, SheetDiscs(grid(0.07, 0.07, 2, 2)[[0, 1, 3, 2]], 0.008, 1e-4), adjacent(4))
    places = touch_grid(Rectangle(0.1, 0.1), 8, 6)
    touched = touched_cells(mesh, Bell(), places.places, thickness=0.01)
    return SensitivityMap(places, linear_changes(model, 1.0, touched))


def test_values_are_norms_of_the_changes(theta):
    np.testing.assert_allclose(theta.values, np.sqrt((np.asarray(theta.changes) ** 2).sum(axis=1)), rtol=1e-12)
    assert float(theta.minimum) == theta.values.min()
    assert float(theta.mean) == pytest.approx(np.mean(theta.values))
    assert 0 < float(theta.uniformity) < 1
    shares, edges = theta.histogram(5)
    assert shares.sum() == pytest.approx(1)
    assert len(edges) == 6


def test_a_symmetric_skin_has_a_symmetric_map(theta):
    """The mesh is not exactly symmetric: rows of cells are staggered."""
    image = theta.image()
    assert image.shape == (6, 8)
    np.testing.assert_allclose(image, image[::-1], rtol=0.1)
    np.testing.assert_allclose(image, image[:, ::-1], rtol=0.1)


def test_the_blind_spot_is_the_fraction_below_a_level(theta):
    level = np.median(np.asarray(theta.values))
    assert float(theta.blind_spot(level)) == pytest.approx(0.5, abs=0.02)
    assert float(theta.blind_spot(theta.minimum)) == 0
    assert float(theta.blind_spot(np.inf)) == 1
    for level in (np.nan, -1.0):
        with pytest.raises(ValueError, match="level must be a sensitivity"):
            theta.blind_spot(level)


def test_a_grid_covers_the_skin():
    whole = touch_grid(Rectangle(0.2, 0.1), 4, 2)
    assert whole.pitch == pytest.approx((0.05, 0.05))
    assert len(whole.places) * whole.cell_area == pytest.approx(0.02)
    np.testing.assert_allclose(whole.places[0], [-0.075, -0.025])
    disk = touch_grid(Disk(0.1), 100, 100)
    assert len(disk.places) * disk.cell_area == pytest.approx(np.pi * 0.01, rel=0.01)
    image = disk.raster(np.arange(len(disk.places)))
    assert np.isnan(image[0, 0])
    assert np.nanmax(image) == len(disk.places) - 1
    hole = Polygon(
        [[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]], [np.array([[0.04, 0.04], [0.06, 0.04], [0.06, 0.06], [0.04, 0.06]])]
    )
    assert len(touch_grid(hole, 10, 10).places) == 96
    with pytest.raises(ValueError, match="one column and one row at least"):
        touch_grid(Disk(0.1), 0, 3)


def test_indentations():
    bell = Bell()
    np.testing.assert_allclose(bell.depth_at(np.array([0, 7.5e-3, 0.03])), [2.5e-3, 2.5e-3 * np.exp(-0.5), 0])
    ball = Hemisphere(depth=2.5e-3)
    np.testing.assert_allclose(ball.depth_at(np.array([0.0, ball.reach, 0.01])), [2.5e-3, 0, 0], atol=1e-12)
    assert ball.depth_at(0.999 * ball.reach) > 0
