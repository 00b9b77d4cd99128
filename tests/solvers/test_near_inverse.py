"""Entries of the inverse near its diagonal, compared with the dense inverse."""

import jax
import numpy as np
import pytest
from sparse_problems import box_cells, dense, disk_cells, element_matrices, from_cells

from jeit_solvers import SparseSymmetric, SparsityPattern, Strips, near_inverse


def three_disks():
    """Three uncoupled parts, side by side and beyond each other."""
    points, cells = disk_cells(60)
    moves = np.array([[0.0, 0.0], [1.5, 3.0], [9.0, 0.0]])
    everywhere = (points + moves[:, None]).reshape(-1, 2)
    return from_cells(everywhere, np.vstack([cells, cells + 60, cells + 120]))


def one_row():
    cells = np.stack([np.arange(20), np.arange(1, 21)], axis=1)
    pattern = SparsityPattern.from_elements([cells], 21)
    return pattern, jax.device_put(pattern.assemble(element_matrices(20, 2))), np.arange(21.0)[:, None]


PROBLEMS = {
    "disk": lambda: from_cells(*disk_cells(90)),
    "box": lambda: from_cells(*box_cells(5)),
    "three disks": three_disks,
    "one row": one_row,
}


@jax.jit
def blocks(inverse, places):
    return inverse.blocks(places)


def all_pairs(strips, inverse, wanted, reach):
    """Pairs of wanted unknowns that are near enough, and the entries of G between them."""
    place = strips.place[wanted]
    strip = place // strips.selected_per_strip
    first, second = np.nonzero(np.abs(strip[:, None] - strip) <= reach)
    found = blocks(inverse, np.stack([place[first], place[second]], axis=1))
    return wanted[first], wanted[second], np.asarray(found)[:, 0, 1]


# By shapes (a disk, where products are added), reaches, and all or every second unknown; each needs a program.
QUICK = {("box", 1, 0.3), ("three disks", 3, 0.3), ("one row", 50, 1.0)}
SLOW = {
    *(("disk", 1, 1.0), ("disk", 3, 0.3), ("disk", 50, 1.0)),
    *(("box", 3, 1.0), ("box", 50, 0.3)),
    *(("three disks", 1, 1.0), ("three disks", 50, 0.3)),
    *(("one row", 1, 0.3), ("one row", 3, 1.0)),
}
CASES = [*sorted(QUICK), *(pytest.param(*case, marks=pytest.mark.slow) for case in sorted(SLOW))]


@pytest.mark.parametrize(("name", "reach", "share"), CASES)
def test_entries_equal_those_of_the_dense_inverse(name, reach, share):
    pattern, values, coordinates = PROBLEMS[name]()
    chosen = np.random.default_rng(0).random(pattern.size) < share
    strips = Strips.create(pattern, coordinates, chosen)
    found = near_inverse(strips, SparseSymmetric(values, pattern), reach)
    expected = np.linalg.inv(dense(pattern, values))
    rows, columns, entries = all_pairs(strips, found, np.flatnonzero(chosen), reach)
    assert len(rows) > chosen.sum()
    np.testing.assert_allclose(entries, expected[rows, columns], rtol=0, atol=1e-13 * np.abs(expected).max())


def test_strips_are_coupled_to_the_next_only_and_contain_all():
    for problem in PROBLEMS.values():
        pattern, _, coordinates = problem()
        strips = Strips.create(pattern, coordinates, np.ones(pattern.size, bool))
        assert len(np.unique(strips.position)) == pattern.size
        strip = strips.position // strips.strip_size
        assert np.abs(strip[np.asarray(pattern.rows)] - strip[np.asarray(pattern.columns)]).max() <= 1
        assert len(np.unique(strip)) == strips.num_strips


def test_products_are_added():
    pattern, values, coordinates = PROBLEMS["disk"]()
    chosen = np.arange(pattern.size) % 3 > 0
    strips = Strips.create(pattern, coordinates, chosen)
    left = np.random.default_rng(1).normal(size=(pattern.size, 4))
    weights = np.diag([1.0, 2.0, 3.0, 4.0])
    inverse = near_inverse(strips, SparseSymmetric(values, pattern), 2)
    more = jax.jit(lambda one, other: inverse.add(strips.spread(one), strips.spread(other)))(left, left @ weights)
    expected = np.linalg.inv(dense(pattern, values)) + left @ weights @ left.T
    rows, columns, entries = all_pairs(strips, more, np.flatnonzero(chosen), 2)
    np.testing.assert_allclose(entries, expected[rows, columns], rtol=0, atol=1e-12 * np.abs(expected).max())


def test_matrices_that_are_not_positive_definite_give_nan():
    pattern, values, coordinates = PROBLEMS["disk"]()
    values = np.array(values)
    values[3] = -1.0
    strips = Strips.create(pattern, coordinates, np.ones(pattern.size, bool))
    found = near_inverse(strips, SparseSymmetric(jax.device_put(values), pattern), 2)
    assert np.isnan(np.asarray(found.band)).any()


def test_groups_reach_from_their_first_strip_to_their_last():
    pattern, _, coordinates = one_row()
    strips = Strips.create(pattern, coordinates, np.ones(21, bool))
    assert strips.max_strip_distance(strips.place[np.array([[0, 0, 1], [4, 9, 6]])]) == 5
    assert strips.max_strip_distance(strips.place[np.array([[7, 7]])]) == 1
