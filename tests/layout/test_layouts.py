"""Arrangements of electrodes: their number, spacing and outline."""

import numpy as np
import pytest

from jeit.layout import grid, named_layout, perimeter, quasi_uniform, ring, ring_and_centre
from jeit.mesh import Disk, Polygon, Rectangle


def nearest_gap(position):
    gap = np.linalg.norm(position[:, None] - position, axis=-1)
    np.fill_diagonal(gap, np.inf)
    return gap.min(axis=1)


def test_ring_begins_at_the_top_and_has_the_given_direction():
    position = ring(2.0, 4)
    np.testing.assert_allclose(position, [[0, 2], [-2, 0], [0, -2], [2, 0]], atol=1e-12)
    np.testing.assert_allclose(ring(2.0, 4, clockwise=True)[1], [2, 0], atol=1e-12)
    assert ring(2.0, 5, height=0.3).shape == (5, 3)


def test_ring_and_centre_puts_the_centre_last():
    position = ring_and_centre(1.0, 8, centre=(3.0, 1.0))
    assert position.shape == (9, 2)
    np.testing.assert_allclose(position[-1], [3, 1], atol=1e-12)


def test_perimeter_is_evenly_spaced_along_the_edge():
    position = perimeter(Rectangle(0.32, 0.2), 16, start=0.01)
    inside = np.abs(position) <= np.array([0.16, 0.1]) + 1e-12
    assert inside.all()
    on_edge = np.isclose(np.abs(position[:, 0]), 0.16) | np.isclose(np.abs(position[:, 1]), 0.1)
    assert on_edge.all()
    assert len(np.unique(position.round(9), axis=0)) == 16


def test_grid_has_the_given_extent():
    position = grid(0.2, 0.1, 4, 3, centre=(1.0, 0.0))
    assert position.shape == (12, 2)
    np.testing.assert_allclose(np.ptp(position, axis=0), [0.2, 0.1])
    np.testing.assert_allclose(position.mean(axis=0), [1, 0], atol=1e-12)


@pytest.mark.parametrize(
    "domain",
    [Disk(0.1), Rectangle(0.2, 0.2), Polygon([[0, 0], [0.3, 0], [0.3, 0.1], [0.1, 0.1], [0.1, 0.3], [0, 0.3]])],
)
def test_quasi_uniform_covers_any_outline_evenly(domain):
    position = quasi_uniform(domain, 32, margin=0.005)
    assert position.shape == (32, 2)
    assert np.asarray(domain.contains(position)).all()
    gap = nearest_gap(position)
    ideal = np.sqrt(2 / np.sqrt(3) * domain.area / 32)
    assert gap.min() > 0.6 * ideal
    assert gap.max() < 1.3 * ideal
    np.testing.assert_array_equal(position, quasi_uniform(domain, 32, margin=0.005))


@pytest.mark.parametrize(
    ("name", "outline", "number"),
    [
        ("grid-5x3", Rectangle(0.1, 0.06, (0.01, 0.02)), 15),
        ("perimeter-16", Rectangle(0.1, 0.06, (0.01, 0.02)), 16),
        ("perimeter-12", Disk(0.05, (0.01, 0.02)), 12),
        ("inner-9", Disk(0.05, (0.01, 0.02)), 9),
        ("inner-9", Polygon([[0, 0], [0.2, 0], [0.2, 0.1], [0, 0.05]]), 9),
    ],
)
def test_named_layouts_for_any_skin_and_diameter(name, outline, number):
    layout = named_layout(name, outline, diameter=4e-3)  # Layout refuses electrodes outside of their skin
    assert (layout.num_electrodes, layout.name, layout.outline) == (number, name, outline)
    np.testing.assert_array_equal(layout.diameters, 4e-3)
    if name.startswith("perimeter") and isinstance(outline, Disk):
        distance = np.linalg.norm(np.asarray(layout.centres) - outline.centre, axis=1)
        np.testing.assert_allclose(distance, 0.05 - 4e-3)  # a radius and 2 mm of skin


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("park-inner", "its skin spans -100 to 100 mm by -100 to 100 mm; on another take inner-32"),
        ("perimeter-8", "'perimeter-8' is of rectangles and disks"),
        ("inner-2000", "has 2000 electrodes; give 1024 or fewer"),
        ("park-iner", "did you mean 'park-inner'"),
    ],
)
def test_names_unsuitable_for_a_skin(name, message):
    with pytest.raises(ValueError, match=message):
        named_layout(name, Polygon([[0, 0], [0.2, 0], [0.2, 0.1], [0, 0.05]]))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("grid-10x2", "would be 5 mm apart, and they are 7 mm across: they would overlap by 2 mm"),
        ("perimeter-8", "electrodes 7 mm across do not fit around the edge"),
    ],
)
def test_names_of_layouts_whose_electrodes_do_not_fit(name, message):
    with pytest.raises(ValueError, match=message):
        named_layout(name, Rectangle(0.05, 0.02 if name == "grid-10x2" else 0.008), diameter=7e-3)
