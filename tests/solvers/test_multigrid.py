"""Multigrid: solutions equal those of dense algebra in NumPy, in compiled programs and in derivatives; the number of
steps does not grow with the mesh; and unsolvable systems give NaN."""

import threading

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import sparse_problems
from sparse_problems import dense

from jeit_solvers import ConjugateGradient, Multigrid, SparseSymmetric, SparsityPattern, choose_solver
from jeit_solvers.sparse import choose, optional_packages

pytest.importorskip("pyamg", reason="PyAMG, of the extra `large`, is not installed")


@pytest.fixture(autouse=True)
def of_many_levels(monkeypatch):
    """Give small problems three levels, and groups of few columns."""
    monkeypatch.setattr(optional_packages, "_MAX_COARSEST_SIZE", 3)
    monkeypatch.setattr(optional_packages, "_MAX_COLUMNS", 2)
    monkeypatch.setattr(optional_packages, "_LAST_HIERARCHY", optional_packages.LastMatrixCache())


def problem(case):
    pattern, values, _ = case()
    return pattern, np.asarray(values), np.random.default_rng(0).normal(size=(pattern.size, 5))


@pytest.mark.parametrize("case", sparse_problems.PROBLEMS, ids=lambda case: case.__name__)
def test_every_problem_is_solved_to_the_tolerance(case):
    pattern, values, vectors = problem(case)
    vectors[:, 1] = 0
    for given in (values, values * (1 + 0.3j * np.sin(np.arange(len(values))))):
        solution = Multigrid().solve_columns(SparseSymmetric(given, pattern), vectors)
        assert solution.dtype == given.dtype
        left = np.linalg.norm(dense(pattern, given) @ solution - vectors, axis=0)
        assert (left <= 2e-10 * np.linalg.norm(vectors, axis=0)).all()


def grid(size, contrast):
    """A square grid of size × size nodes with a given ratio of conductances, grounded at one node."""
    number = np.arange(size * size).reshape(size, size)
    pairs = np.concatenate([
        np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()], axis=1),
        np.stack([number[1:].ravel(), number[:-1].ravel()], axis=1),
    ])  # fmt: skip
    conductance = contrast ** np.random.default_rng(0).uniform(-0.5, 0.5, len(pairs))
    diagonal = np.bincount(pairs.ravel(), np.repeat(conductance, 2))
    diagonal[0] *= 2
    rows, columns = (np.concatenate([np.arange(size * size), pairs[:, side]]) for side in (0, 1))
    pattern = SparsityPattern.from_entries(rows, columns, size * size)
    return pattern, np.asarray(pattern.assemble(np.concatenate([diagonal, -conductance])))


def steps(pattern, values):
    """Number of steps until the tolerance, by bisection of the maximum."""
    load = np.zeros((pattern.size, 1))
    load[[0, -1], 0] = 1, -1
    least, enough = 0, 128
    while enough - least > 1:
        middle = (least + enough) // 2
        found = Multigrid(max_steps=middle).solve_columns(SparseSymmetric(values, pattern), load)
        least, enough = (middle, enough) if np.isnan(found).any() else (least, middle)
    return enough


def test_steps_depend_neither_on_the_mesh_nor_on_the_contrast():
    """With a diagonal preconditioner, for example, the number of steps is proportional to the size."""
    few = steps(*grid(12, 1.0))
    assert few < 25
    assert steps(*grid(96, 1.0)) < 2 * few
    assert steps(*grid(48, 100.0)) < 3 * few


def test_right_hand_sides_of_every_kind():
    pattern, values, vectors = problem(sparse_problems.disk)
    matrix = dense(pattern, values)
    for given in (vectors * (1 + 2j), vectors[:, :0], np.asfortranarray(vectors), vectors[:, ::-1], vectors[:, :1]):
        found = Multigrid().solve_columns(SparseSymmetric(values, pattern), given)
        np.testing.assert_allclose(matrix @ found, given, rtol=0, atol=1e-9)


def test_complex_loads_whose_squares_cancel():
    """The loads of a real system; the conjugate orthogonal variant breaks down at once."""
    pattern, values, _ = problem(sparse_problems.diagonal)
    load = np.zeros((pattern.size, 1), complex)
    load[[0, 1], 0] = 1, 1j * np.sqrt(2)
    found = Multigrid().solve_columns(SparseSymmetric(values, pattern), load)
    np.testing.assert_allclose(found[:, 0], load[:, 0] / np.arange(1, 41), atol=1e-12)


@pytest.mark.parametrize("size", [1e-60, 1e50])
def test_loads_beyond_single_precision(size):
    pattern, values, vectors = problem(sparse_problems.disk)
    found = Multigrid().solve_columns(SparseSymmetric(values, pattern), size * vectors)
    np.testing.assert_allclose(dense(pattern, values) @ found, size * vectors, rtol=0, atol=1e-9 * size)


@pytest.mark.parametrize("entry", [-1.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_gives_nan(entry):
    pattern, values, vectors = problem(sparse_problems.disk)
    values = np.array(values)
    values[17] = entry
    for given in (values, values.astype(complex)):
        assert np.isnan(Multigrid().solve_columns(SparseSymmetric(given, pattern), vectors)).all()


def test_an_indefinite_matrix_with_a_positive_diagonal_gives_nan():
    pattern, values, vectors = problem(sparse_problems.disk)
    values = np.array(values)
    values[pattern.size :] *= 3
    assert np.isnan(Multigrid().solve_columns(SparseSymmetric(values, pattern), vectors)).any()


def test_columns_that_exceed_the_maximum_of_steps_are_nan():
    pattern, values, vectors = problem(sparse_problems.disk)
    vectors[:, 3] = 0
    found = Multigrid(max_steps=2).solve_columns(SparseSymmetric(values, pattern), vectors)
    assert np.isnan(found).all(axis=0).tolist() == [True, True, True, False, True]


class Compiled:
    """The disk solved in compiled programs, which call NumPy."""

    pattern, values, vectors = problem(sparse_problems.disk)

    @classmethod
    def energy(cls, values, vector):
        return vector @ lineax.linear_solve(SparseSymmetric(values, cls.pattern), vector, Multigrid(1e-13)).value


def test_compiled_programs_and_their_derivatives():
    vector, values = jnp.asarray(Compiled.vectors[:, 0]), jnp.asarray(Compiled.values)
    solution = np.linalg.solve(dense(Compiled.pattern, values), vector)
    energy, slope = jax.jit(jax.value_and_grad(Compiled.energy))(values, vector)
    np.testing.assert_allclose(energy, vector @ solution, rtol=1e-12)
    rows, columns = np.asarray(Compiled.pattern.rows), np.asarray(Compiled.pattern.columns)
    expected = -solution[rows] * solution[columns] * np.where(rows == columns, 1, 2)
    np.testing.assert_allclose(slope, expected, rtol=1e-9, atol=1e-11 * abs(expected).max())
    several = values * (1 + np.arange(3)[:, None])
    batch = jax.jit(jax.vmap(Compiled.energy, in_axes=(0, None)))(several, vector)
    np.testing.assert_allclose(batch, energy / (1 + np.arange(3)), rtol=1e-12)


def test_eight_threads_solve_separate_matrices():
    solved = jax.jit(Compiled.energy)
    vector, found = jnp.asarray(Compiled.vectors[:, 0]), np.full(8, np.nan)

    def work(number):
        found[number] = solved(Compiled.values * (1 + number), vector)

    threads = [threading.Thread(target=work, args=(number,), daemon=True) for number in range(8)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(60)
    assert not any(one.is_alive() for one in threads)
    np.testing.assert_allclose(found * (1 + np.arange(8)), found[0], rtol=1e-12)


def test_invalid_requests_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="`tolerance` must be between 0 and 1; got 1"):
        Multigrid(1.0)
    with pytest.raises(ValueError, match="`max_steps` must be positive; got 0"):
        Multigrid(max_steps=0)
    with pytest.raises(ValueError, match=r"Multigrid solves systems with `SparseSymmetric`"):
        Multigrid().init(lineax.MatrixLinearOperator(np.eye(3)), {})
    monkeypatch.setattr(optional_packages, "find_spec", lambda _: None)
    with pytest.raises(ImportError, match=r"needs pyamg: pip install 'jeit\[large\]'"):
        Multigrid()


def test_chosen_where_a_factor_does_not_fit_or_takes_longer(monkeypatch):
    pattern, values, vectors = problem(sparse_problems.box)
    too_large = choose_solver(pattern, memory_limit=1e3)
    assert isinstance(too_large, Multigrid)
    assert "0 MB are allowed" in too_large.reason
    found = too_large.solve_columns(SparseSymmetric(values, pattern), vectors)
    np.testing.assert_allclose(dense(pattern, values) @ found, vectors, rtol=0, atol=1e-9)
    monkeypatch.setattr(choose, "_OPERATIONS_PER_SECOND", 1.0)
    assert isinstance(choose_solver(pattern), Multigrid)
    monkeypatch.setattr(choose, "multigrid_is_installed", lambda: False)
    assert not isinstance(choose_solver(pattern), Multigrid | ConjugateGradient)
    without = choose_solver(pattern, memory_limit=1e3)
    assert isinstance(without, ConjugateGradient)
    assert "pip install 'jeit[large]'" in without.reason
