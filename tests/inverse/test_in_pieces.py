"""Computations by blocks of cells or columns: results do not depend on the blocks."""

import threading

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.forward import model as forward_model
from jeit.inverse import Laplace, one_step
from jeit.inverse.linear import greit
from jeit.inverse.linearisation import Linearisation, combined_jacobian
from jeit.inverse.prior.bases import DenseBasis, DiagonalBasis, NodalBasis
from jeit.inverse.prior.linear_algebra import apply_to_columns
from jeit.layout import ring
from jeit.mesh import Disk, box
from jeit.protocol import adjacent
from jeit_solvers import number_of_cores
from jeit_solvers.engines import host

RANDOM = np.random.default_rng(0)


@pytest.fixture(scope="module")
def model():
    return ForwardModel(Disk(0.1).mesh(num_points=200), BoundaryElectrodes(ring(0.1, 16), 0.012, 1e-3), adjacent(16))


@pytest.mark.parametrize("number", [208, 100], ids=["of fields' products", "of channels"])
def test_jacobians_by_blocks(number, model, monkeypatch):
    """With more channels than products of fields, and with fewer."""
    weights, channels = RANDOM.normal(size=(3, number)), np.arange(number)
    expected = weights @ np.asarray(model.jacobian(1.0))[:number]
    monkeypatch.setattr(forward_model, "_CELLS_AT_ONCE", 70)
    monkeypatch.setattr(forward_model, "_MAX_BLOCK_ENTRIES", 70 * number)
    assert model.mesh.num_cells > 3 * 70
    assert model.mesh.num_cells % 70
    found = combined_jacobian(model, 1.0, channels, weights)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * abs(expected).max())


@pytest.mark.parametrize("kind", ["nodal", "diagonal", "dense"])
def test_restricted_rows_by_blocks(kind):
    mesh = box(0.1, 0.1, 0.1, num_points=60)
    count, cells = mesh.num_cells, host.asarray(mesh.cells)
    means, deviation = host.zeros((count, mesh.num_points)), host.arange(1.0, count + 1)
    np.add.at(means, (np.arange(count)[:, None], cells), 1 / 4)
    given = {
        "nodal": (NodalBasis(cells, mesh.num_points), means),
        "diagonal": (DiagonalBasis(deviation), np.diag(deviation)),
        "dense": (DenseBasis(means), means),
    }
    (basis, shapes), rows = given[kind], RANDOM.normal(size=(5, count))
    pieces = [slice(start, min(start + 50, count)) for start in range(0, count, 50)]
    assert len(pieces) > 2
    found = basis.restrict_blocks((cells, rows[:, cells]) for cells in pieces)
    np.testing.assert_allclose(found, rows @ shapes, atol=1e-12)
    np.testing.assert_allclose(basis.restrict(rows), rows @ shapes, atol=1e-12)


@pytest.mark.parametrize("number", [1, 32, 33, 64, 100])
def test_columns_by_blocks(number):
    matrix, columns = RANDOM.normal(size=(7, 5)), RANDOM.normal(size=(5, number))
    np.testing.assert_allclose(apply_to_columns(lambda part: matrix @ part, columns, 7), matrix @ columns, rtol=1e-12)


def test_columns_are_always_solved_on_the_same_threads():
    """Memory allocated by new threads would stay with the process."""
    threads = set()

    def noted(part):
        threads.add(threading.current_thread())
        return part

    for _ in range(3):
        apply_to_columns(noted, np.ones((2, 640)), 2)
    assert len(threads) <= number_of_cores() + 1


def test_images_of_a_linear_problem_are_not_copied_for_jax(model):
    """Those of a solid body take a third of a gigabyte each; copies by JAX, which are read-only, would double it."""
    images, weights = Linearisation.create(model, 1.0, prior=Laplace()).factors(3.0)
    assert images.flags.writeable
    matrix = one_step(model, 1.0, prior=Laplace(), hyperparameter=3.0).matrix
    np.testing.assert_allclose(images @ weights, matrix, rtol=0, atol=1e-9 * abs(np.asarray(matrix)).max())


def test_samples_far_from_all_targets_are_skipped(monkeypatch):
    """Fractions covered by balls equal those with all samples; the grid does not start at the body's corner."""
    mesh = box(0.1, 0.13, 0.09, num_points=400)
    middle = np.array([0.003, -0.004, 0.046])
    position, covered = greit._place_targets(mesh, middle, 0.012, 60)
    monkeypatch.setattr(greit, "_SEARCH_RADII", 1e6)
    everywhere, expected = greit._place_targets(mesh, middle, 0.012, 60)
    np.testing.assert_array_equal(position, everywhere)
    assert len(position) > 5
    np.testing.assert_allclose(covered.toarray(), expected.toarray(), rtol=0, atol=1e-12)
