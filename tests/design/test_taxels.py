"""Virtual taxels: against angles computed by hand, sums in NumPy, and the effect that interior electrodes must have."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.design import find_taxels
from jeit.layout import grid

SIDE = 0.2
PLACES = grid(SIDE * 15 / 16, SIDE * 15 / 16, 16, 16)
CELL = (SIDE / 16) ** 2


def two_terminal_changes(electrodes, pairs=40):
    """Changes (256, pairs) on an infinite sheet.

    At each place: the squared field of the nearest pairs of electrodes, each a source and a sink, softened within 10 mm
    of them.
    """
    first, second = np.triu_indices(len(electrodes), 1)
    nearest = np.argsort(np.linalg.norm(electrodes[first] - electrodes[second], axis=1), kind="stable")[:pairs]
    away = PLACES[:, None] - electrodes
    field = away / (np.sum(away**2, axis=2, keepdims=True) + 1e-4)
    return 1e-6 * np.sum((field[:, first[nearest]] - field[:, second[nearest]]) ** 2, axis=2)


def inside():
    return grid(0.15, 0.15, 4, 4)


def boundary():
    corner, step = 0.095, np.linspace(-0.095, 0.095, 5)[:4]
    side = np.column_stack([step, np.full(4, -corner)])
    turns = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in np.pi / 2 * np.arange(4)]
    return np.concatenate([side @ turn.T for turn in turns])


@pytest.fixture(scope="module")
def layouts():
    return np.stack([two_terminal_changes(inside()), two_terminal_changes(boundary())])


@pytest.fixture(scope="module")
def found(layouts):
    return [find_taxels(changes, PLACES, CELL, num_taxels=20, key=jax.random.key(0)) for changes in layouts]


def test_areas_are_those_of_an_angle():
    """Changes that rotate by 20 rad/m along a strip, at any length: a taxel is ± arccos 0.7 wide."""
    x = (np.arange(128) + 0.5) * SIDE / 128
    places = np.column_stack([np.repeat(x, 2), np.tile([0.0, 0.01], 128)])
    angle = 20 * places[:, 0]
    changes = np.zeros((256, 40))
    changes[:, :2] = np.column_stack([np.cos(angle), np.sin(angle)]) * (1 + 0.3 * np.sin(50 * places[:, :1]))
    taxels = find_taxels(changes, places, SIDE / 128 * 0.01, num_taxels=20, key=jax.random.key(1))
    cosine, sine = np.asarray(taxels.clusters.centres)[:, :2].T
    middle = np.arctan2(sine, cosine) % (2 * np.pi)
    low, high = middle - np.arccos(0.7), middle + np.arccos(0.7)
    expected = (np.minimum(high / 20, SIDE) - np.maximum(low / 20, 0)) * 0.02
    # One cell at either end, of two rows.
    np.testing.assert_allclose(taxels.areas, expected, atol=2 * SIDE / 128 * 0.02)
    assert 0.5 < expected.min() / expected.max() < 0.7
    np.testing.assert_allclose(taxels.positions[:, 0], middle / 20, atol=1e-3)


def test_figures_are_sums_over_places(layouts, found):
    """All of them recomputed, in loops, from the labels alone."""
    changes, taxels = layouts[1], found[1]
    labels = np.asarray(taxels.labels)
    assert set(labels) == set(range(20))
    areas = []
    covered = np.zeros(256, int)
    for index in range(20):
        mean = changes[labels == index].mean(axis=0)
        cosine = np.array([mean @ v / np.linalg.norm(mean) / np.linalg.norm(v) for v in changes])
        np.testing.assert_allclose(taxels.similarity[index], cosine, rtol=1e-10)
        covered += cosine >= 0.7
        areas.append(CELL * np.sum(cosine >= 0.7))
        np.testing.assert_allclose(taxels.positions[index], PLACES[labels == index].mean(axis=0), atol=1e-15)
    np.testing.assert_allclose(taxels.areas, areas)
    np.testing.assert_array_equal(taxels.coverage, covered)
    np.testing.assert_array_equal(np.asarray(taxels.members).sum(axis=0), covered)
    assert float(taxels.mean_area) == pytest.approx(np.mean(areas))
    assert float(taxels.std_area) == pytest.approx(np.std(areas))
    assert float(taxels.max_area) == pytest.approx(np.max(areas))
    assert float(taxels.overlap) == pytest.approx(covered.mean())
    assert float(taxels.two_point_discrimination) == pytest.approx(np.mean(np.sqrt(4 * np.array(areas) / np.pi)))


def test_cells_of_unequal_areas_are_weighted(layouts, found):
    area = np.random.default_rng(0).uniform(0.5, 1.5, 256) * CELL
    taxels = find_taxels(layouts[0], PLACES, area, num_taxels=20, key=jax.random.key(0))
    np.testing.assert_array_equal(taxels.members, found[0].members)
    np.testing.assert_allclose(taxels.areas, np.asarray(taxels.members) @ area)
    assert float(taxels.overlap) == pytest.approx(np.sum(taxels.coverage * area) / area.sum())
    inside = np.asarray(taxels.labels) == 3
    np.testing.assert_allclose(taxels.positions[3], area[inside] @ PLACES[inside] / area[inside].sum())


def test_interior_electrodes_make_smaller_taxels(found):
    """As in the paper: by a clear margin, with more uniform sizes and less overlap."""
    inner, outer = found
    assert float(inner.mean_area) < 0.7 * float(outer.mean_area)
    assert float(inner.std_area) < 0.7 * float(outer.std_area)
    assert float(inner.overlap) < 0.7 * float(outer.overlap)
    assert float(inner.two_point_discrimination) < 0.9 * float(outer.two_point_discrimination)


def test_a_lower_threshold_makes_larger_taxels(layouts, found):
    options = {"num_taxels": 20, "key": jax.random.key(0)}
    wide = find_taxels(layouts[0], PLACES, CELL, threshold=0.5, **options)
    np.testing.assert_array_equal(wide.labels, found[0].labels)
    assert np.all(wide.areas > found[0].areas)


def test_units_of_voltage_do_not_matter(layouts, found):
    taxels = find_taxels(1e-6 * layouts[0], PLACES, CELL, num_taxels=20, key=jax.random.key(0))
    np.testing.assert_array_equal(taxels.labels, found[0].labels)
    np.testing.assert_allclose(taxels.similarity, found[0].similarity, rtol=1e-10)


def test_directions_do_not_depend_on_the_sensitivity_of_places(layouts):
    """A skin pressed harder in some places: unscaled changes form other clusters, scaled ones do not."""
    harder = np.random.default_rng(1).uniform(0.3, 3, (256, 1)) * layouts[0]
    options = {"num_taxels": 20, "key": jax.random.key(0)}

    def both(directions):
        return [
            find_taxels(changes, PLACES, CELL, directions=directions, **options) for changes in (layouts[0], harder)
        ]

    even, uneven = both(directions=True)
    np.testing.assert_array_equal(even.labels, uneven.labels)
    np.testing.assert_allclose(even.areas, uneven.areas)
    own = even.similarity[even.labels, np.arange(256)]
    assert float(own.min()) > 0.5
    even, uneven = both(directions=False)
    assert not np.array_equal(even.labels, uneven.labels)


def test_insensitive_places_are_in_no_taxel(layouts):
    changes = layouts[0].copy()
    changes[[5, 200]] = 0
    taxels = find_taxels(changes, PLACES, CELL, num_taxels=20, key=jax.random.key(0))
    assert np.isfinite(taxels.similarity).all()
    np.testing.assert_array_equal(taxels.coverage[np.array([5, 200])], 0)


@pytest.mark.slow
def test_a_batch_of_layouts_equals_a_loop(layouts, found):
    keys = jnp.stack([jax.random.key(0)] * 2)

    def find(changes, key):
        return find_taxels(changes, PLACES, CELL, num_taxels=20, key=key)

    together = jax.tree.map(np.asarray, jax.jit(jax.vmap(find))(layouts, keys))
    for index, alone in enumerate(found):
        np.testing.assert_array_equal(together.labels[index], alone.labels)
        np.testing.assert_allclose(together.similarity[index], alone.similarity, rtol=1e-10)
        for name in ("positions", "areas", "coverage", "diameters", "mean_area", "std_area", "max_area", "overlap"):
            np.testing.assert_allclose(getattr(together, name)[index], getattr(alone, name), rtol=1e-10, atol=1e-15)
        one = jax.tree.map(lambda array, index=index: array[index], together)
        assert float(one.two_point_discrimination) == pytest.approx(float(alone.two_point_discrimination))


@pytest.mark.slow
def test_similarity_has_a_derivative(layouts):
    """The gradient against a central difference, with fixed clusters and an insensitive place, without a direction."""
    changes = 1e6 * layouts[0]
    changes[5] = 0

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def mean_square(changes):
        taxels = find_taxels(changes, PLACES, CELL, num_taxels=20, key=jax.random.key(0))
        return jnp.mean(taxels.similarity**2), taxels.labels

    (_, labels), slope = mean_square(changes)
    # The direction of an insensitive place is not continuous.
    steepest = np.array(slope) / np.linalg.norm(slope)
    steepest[5] = 0
    step = 1e-3
    (above, one), (below, other) = (mean_square(changes + sign * step * steepest)[0] for sign in (1, -1))
    np.testing.assert_array_equal(one, labels)
    np.testing.assert_array_equal(other, labels)
    assert np.sum(slope * steepest) == pytest.approx((float(above) - float(below)) / (2 * step), rel=1e-6)


@pytest.mark.parametrize(
    ("match", "change"),
    [
        ("changes has shape", {"changes": np.ones(256)}),
        ("changes has shape", {"places": PLACES[:-1]}),
        ("changes has shape", {"places": np.zeros((256, 3))}),
        ("changes has shape", {"cell_area": np.ones(3)}),
        ("changes are complex", {"changes": np.ones((256, 4)) * 1j}),
        ("1 of 256 places are NaN", {"changes": np.where(np.arange(256)[:, None] == 7, np.nan, np.ones((256, 4)))}),
        ("changes are all zero", {"changes": np.zeros((256, 4))}),
        ("num_taxels must be", {"num_taxels": 257}),
        ("num_taxels must be", {"num_taxels": 9.0}),
        ("threshold is a cosine", {"threshold": 45}),
        ("places must be finite", {"places": np.nan * PLACES}),
        ("cell_area must be positive", {"cell_area": -CELL}),
        ("places in metres and cell_area in m²", {"places": 1e3 * PLACES}),
        ("places in metres and cell_area in m²", {"cell_area": 1e4 * CELL}),
    ],
)
def test_refuses_bad_input(match, change):
    arguments = {"changes": np.ones((256, 4)), "places": PLACES, "cell_area": CELL, "num_taxels": 9}
    with pytest.raises(ValueError, match=match):
        find_taxels(**(arguments | {"key": jax.random.key(0)} | change))
