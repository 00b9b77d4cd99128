"""PARDISO: solutions and derivatives equal those of dense algebra, and unsolvable systems give NaN."""

import threading

import jax
import lineax
import numpy as np
import pytest
import sparse_problems
from sparse_problems import dense

from jeit_solvers import Pardiso, SparseSymmetric
from jeit_solvers.sparse import optional_packages

installed = pytest.mark.skipif(
    optional_packages.find_spec("pypardiso") is None, reason="pypardiso, of the extra `mkl`, is not installed"
)


def problem(case):
    pattern, values, _ = case()
    return pattern, np.asarray(values), np.random.default_rng(0).normal(size=(pattern.size, 5))


@installed
@pytest.mark.parametrize("case", sparse_problems.PROBLEMS, ids=lambda case: case.__name__)
def test_every_problem_is_solved(case):
    """Real and complex matrices with real and complex loads."""
    pattern, values, vectors = problem(case)
    for given in (values, values * (1 + 0.3j * np.sin(np.arange(len(values))))):
        for load in (vectors, vectors * (1 + 2j), vectors[:, :1], vectors[:, ::-1]):
            found = Pardiso().solve_columns(SparseSymmetric(given, pattern), load)
            assert found.dtype == np.result_type(given, load)
            left = dense(pattern, given) @ found - load
            assert np.linalg.norm(left) < 1e-11 * np.linalg.norm(load)


@installed
@pytest.mark.parametrize("entry", [-1.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_gives_nan(entry):
    pattern, values, vectors = problem(sparse_problems.disk)
    values = np.array(values)
    values[17] = entry
    assert np.isnan(Pardiso().solve_columns(SparseSymmetric(values, pattern), vectors)).all()


@installed
def test_compiled_programs_and_their_derivatives():
    """The energy bᵀ A⁻¹ b and its slope −xᵀ (dA) x, against dense algebra."""
    pattern, values, vectors = problem(sparse_problems.disk)
    vector = vectors[:, 0]

    @jax.jit
    @jax.value_and_grad
    def energy(values):
        return vector @ lineax.linear_solve(SparseSymmetric(values, pattern), vector, Pardiso()).value

    found, slope = energy(values)
    solution = np.linalg.solve(dense(pattern, values), vector)
    np.testing.assert_allclose(found, vector @ solution, rtol=1e-12)
    change = np.random.default_rng(1).normal(size=values.shape)
    np.testing.assert_allclose(slope @ change, -solution @ dense(pattern, change) @ solution, rtol=1e-9)


@installed
def test_threads_do_not_disturb_each_other():
    pattern, values, vectors = problem(sparse_problems.disk)
    operators = [SparseSymmetric(values * factor, pattern) for factor in (1.0, 2.0, 1.0, 3.0)]
    found: dict[int, np.ndarray] = {}

    def solve(number):
        for _ in range(5):
            found[number] = np.asarray(Pardiso().solve_columns(operators[number], vectors))

    threads = [threading.Thread(target=solve, args=(number,)) for number in range(len(operators))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number, factor in enumerate((1.0, 2.0, 1.0, 3.0)):
        np.testing.assert_allclose(factor * found[number], found[0], rtol=1e-12)


def test_error_without_the_package_names_it(monkeypatch):
    monkeypatch.setattr(optional_packages, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"Pardiso needs pypardiso: pip install 'jeit\[mkl\]'"):
        Pardiso()
