"""The direct solver against SciPy and dense algebra, for every problem and number type."""

import gc
import weakref

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import sparse_problems
from scipy.sparse.linalg import splu
from sparse_problems import dense

from jeit_solvers import (
    SparseCholesky,
    SparseSymmetric,
    SparsityPattern,
    analyse,
    factorise,
    half_solve,
    inverse_entries,
    inverse_root,
    quadratic_form,
    solve,
)
from jeit_solvers.engines import on_device, on_host
from jeit_solvers.sparse import padded_fronts

# Residuals relative to |A| |x|; a backward stable solver reaches a small multiple of the unit roundoff.
TOLERANCE = {"float32": 3e-6, "float64": 5e-15, "complex128": 5e-15}


def as_type(values, dtype):
    if dtype == "complex128":
        # Any symmetric imaginary part is suitable; this one is not a multiple of the real part.
        rng = np.random.default_rng(5)
        return values + 0.5j * values * jnp.asarray(rng.uniform(-1, 1, values.shape))
    return values.astype(dtype)


# Compiling takes a second for each problem: the quick tests have fronts in stages, of all sizes, and a single one.
COMPILED = [
    pytest.param(case, "float64", marks=() if case is sparse_problems.diagonal else pytest.mark.slow)
    for case in sparse_problems.PROBLEMS
]
COMPILED += [(sparse_problems.disk, "float32"), (sparse_problems.disk, "complex128")]


def name_of(value):
    return getattr(value, "__name__", value)


def everything(plan, values, vectors, rows):
    """All results of one factorisation: itself, solutions, bᵀA⁻¹b, half-solutions, entries and a root of the
    inverse."""
    factor = factorise(plan, values)
    form, half = quadratic_form(plan, factor, vectors), half_solve(plan, factor, vectors)
    inverse = inverse_entries(plan, factor), inverse_root(plan, factor, rows)
    return factor, solve(plan, factor, vectors), form, half, *inverse


@jax.jit
def compiled(*arguments):
    factor, *found = everything(*arguments)
    return factor.positive_definite, *found


def assert_solves_to_roundoff(case, dtype, engine):
    pattern, values, coordinates = case()
    values = as_type(np.asarray(values), dtype)
    plan = analyse(pattern, coordinates)
    vectors = np.random.default_rng(0).normal(size=(pattern.size, 5)).astype(dtype)
    work = everything if engine is on_host else compiled
    verdict, *found = work(*engine((plan, values, vectors, np.eye(plan.num_pivots, dtype=values.dtype))))
    assert engine is on_host or verdict
    assert all(isinstance(one, np.ndarray) == (engine is on_host) for one in found)
    solution, form, half, entries, root = map(np.asarray, found)
    assert solution.dtype == values.dtype
    matrix = dense(pattern, values)
    residual = np.linalg.norm(matrix @ solution - vectors) / np.linalg.norm(matrix) / np.linalg.norm(solution)
    assert residual < TOLERANCE[dtype]
    # Forward errors may be larger by the condition numbers, which are below 1e3.
    tolerance = 1e3 * TOLERANCE[dtype]
    np.testing.assert_allclose(form, vectors.T @ solution, rtol=0, atol=tolerance * abs(form).max())
    np.testing.assert_allclose(half.T @ half, form, rtol=0, atol=tolerance * abs(form).max())
    inverse = np.linalg.inv(matrix)
    least = tolerance * abs(inverse).max() if dtype == "float32" else 1e-12 * abs(inverse).max()
    rows, columns = np.asarray(pattern.rows), np.asarray(pattern.columns)
    np.testing.assert_allclose(entries, inverse[rows, columns], rtol=0, atol=least)
    np.testing.assert_allclose(root @ root.T, inverse, rtol=0, atol=least)


@pytest.mark.parametrize("case", sparse_problems.PROBLEMS, ids=name_of)
def test_numpy_solves_every_problem_to_roundoff(case):
    assert_solves_to_roundoff(case, "float64", on_host)
    if case is sparse_problems.disk:
        assert_solves_to_roundoff(case, "complex128", on_host)


@pytest.mark.parametrize(("case", "dtype"), COMPILED, ids=name_of)
def test_compiled_code_solves_problems_to_roundoff(case, dtype):
    assert_solves_to_roundoff(case, dtype, on_device)


def test_a_small_matrix_is_a_single_front(monkeypatch):
    case = sparse_problems.diagonal
    pattern, _, coordinates = case()
    monkeypatch.setattr(padded_fronts, "_MAX_SINGLE_FRONT", pattern.size)
    assert len(analyse(pattern, coordinates).stages) == 1
    assert_solves_to_roundoff(case, "float64", on_host)
    monkeypatch.setattr(padded_fronts, "_MAX_SINGLE_FRONT", pattern.size - 1)
    assert len(analyse(pattern, coordinates).stages) > 1


def test_entries_of_the_inverse_at_pairs_of_nodes_of_an_element():
    points, cells = sparse_problems.disk_cells(30)
    pattern, values, _ = on_host(sparse_problems.from_cells(points, cells))
    inverse = np.linalg.inv(dense(pattern, values))
    plan = on_host(analyse(pattern, points))
    between = pattern.entries_between(inverse_entries(plan, factorise(plan, values)))
    row, column = np.tril_indices(3)
    np.testing.assert_allclose(between, inverse[cells[:, row], cells[:, column]].T, rtol=1e-11)


def test_roots_are_refused_for_rows_in_another_order():
    pattern, values, coordinates = on_host(sparse_problems.disk())
    plan = on_host(analyse(pattern, coordinates))
    with pytest.raises(ValueError, match="inverse_root: rows"):
        inverse_root(plan, factorise(plan, values), np.ones((plan.num_pivots + 1, 2)))


@pytest.mark.parametrize("engine", [on_host, pytest.param(on_device, marks=pytest.mark.slow)], ids=["numpy", "jax"])
def test_agrees_with_superlu_on_a_large_disk(engine):
    points, cells = sparse_problems.disk_cells(1500)
    pattern, values, _ = sparse_problems.from_cells(points, cells)
    vectors = np.random.default_rng(0).standard_normal((pattern.size, 3))
    expected = splu(pattern.to_scipy(values).tocsc()).solve(vectors)

    def solved(plan, values, vectors):
        return solve(plan, factorise(plan, values), vectors)

    work = solved if engine is on_host else jax.jit(solved)
    solution = work(*engine((analyse(pattern, points), values, vectors)))
    np.testing.assert_allclose(solution, expected, rtol=0, atol=1e-12 * abs(expected).max())


@pytest.mark.slow
def test_one_vector_is_a_column_and_jit_equals_eager():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    plan = analyse(pattern, coordinates)
    vector = np.random.default_rng(0).normal(size=pattern.size)
    eager = np.asarray(solve(plan, factorise(plan, values), jnp.asarray(vector)))
    both = jax.jit(lambda plan, values, vectors: solve(plan, factorise(plan, values), vectors))
    np.testing.assert_allclose(eager, both(plan, values, vector[:, None])[:, 0], rtol=0, atol=1e-13 * abs(eager).max())


def test_one_executable_serves_all_values():
    pattern, values, coordinates = sparse_problems.disk()
    plan = analyse(pattern, coordinates)
    jitted = jax.jit(factorise)
    jitted(plan, values)
    jitted(analyse(pattern, coordinates), 2 * values)  # another plan of equal structure
    assert jitted._cache_size() == 1


def test_a_batch_is_solved_and_reports_which_matrix_failed():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    plan = analyse(pattern, coordinates)
    batch = np.asarray(values) * (1 + 0.1 * np.random.default_rng(0).uniform(0.5, 2.0, (4, pattern.num_entries)))
    batch[1, 0] = -1.0
    vectors = np.random.default_rng(1).normal(size=(pattern.size, 2))

    @jax.jit
    @jax.vmap
    def both(values):
        factor = factorise(plan, values)
        return factor.positive_definite, solve(plan, factor, jnp.asarray(vectors))

    verdict, together = both(batch)
    assert verdict.tolist() == [True, False, True, True]
    for k in (0, 2, 3):
        expected = np.linalg.solve(dense(pattern, batch[k]), vectors)
        np.testing.assert_allclose(together[k], expected, rtol=0, atol=1e-12 * abs(expected).max())


@pytest.mark.parametrize("dtype", ["float64", pytest.param("complex128", marks=pytest.mark.slow)])
def test_matrices_that_are_not_positive_definite_are_refused(dtype):
    """With a negative pivot, singular, and with NaN."""
    pattern, values, points = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    plan, vector = analyse(pattern, points), np.ones(pattern.size, dtype)

    @jax.jit
    def both(values):
        operator = SparseSymmetric(values, pattern)
        solution = lineax.linear_solve(operator, jnp.asarray(vector), SparseCholesky(plan), throw=False)
        return factorise(plan, values), solution.result == lineax.RESULTS.singular

    for index, value in ((7, -5.0), (7, 0.0), (3, np.nan)):
        bad = np.array(as_type(np.asarray(values), dtype))
        bad[index] = value
        factor, singular = both(bad)
        assert singular
        assert not factor.positive_definite
        with pytest.raises(ValueError, match=r"not positive definite.*boundary condition"):
            factor.require_positive_definite()


def test_lineax_throws_on_an_indefinite_matrix():
    pattern, values, coordinates = sparse_problems.chain()
    solver = SparseCholesky(analyse(pattern, coordinates))
    with pytest.raises(Exception, match="positive definiteness"):
        lineax.linear_solve(SparseSymmetric(-values, pattern), jnp.ones(pattern.size), solver)


@pytest.mark.slow
def test_nested_batches_and_gradients_of_batches():
    """The derivative of the energy bᵀA⁻¹b in entry (i, j) is −x_i x_j, and the same in (j, i), where x is the
    solution."""
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    plan = analyse(pattern, coordinates)
    batch = np.asarray(values) * np.linspace(1.0, 2.0, 6).reshape(2, 3, 1)
    vectors = np.random.default_rng(2).normal(size=(4, pattern.size))

    def energy(values, vector):
        return vector @ solve(plan, factorise(plan, values), vector)

    over_vectors = jax.vmap(jax.value_and_grad(energy), in_axes=(None, 0))
    everywhere = jax.jit(jax.vmap(jax.vmap(over_vectors, in_axes=(0, None)), in_axes=(0, None)))
    found, slope = everywhere(batch, vectors)
    solutions = np.stack([[np.linalg.solve(dense(pattern, one), vectors.T).T for one in some] for some in batch])
    np.testing.assert_allclose(found, (solutions * vectors).sum(axis=-1), rtol=1e-11)
    rows, columns = np.asarray(pattern.rows), np.asarray(pattern.columns)
    expected = -solutions[..., rows] * solutions[..., columns] * np.where(rows == columns, 1, 2)
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-9 * abs(vectors).max() ** 2)


def test_the_elimination_order_does_not_depend_on_scale_or_position():
    """Nor on rounding of equal coordinates: a scaled body has the same plan and compiled code."""
    points = np.stack(np.meshgrid(np.arange(24.0), np.arange(24.0)), axis=-1).reshape(-1, 2)
    corner = (np.arange(23)[:, None] * 24 + np.arange(23)).ravel()
    cells = np.concatenate([corner[:, None] + [0, 1, 25], corner[:, None] + [0, 25, 24]])
    pattern = SparsityPattern.from_elements([cells], len(points))
    plan = analyse(pattern, points)
    for factor, shift in ((0.05, 0.0), (0.06, 0.0), (1 / 3, 0.7), (1.0, -11.1)):
        other = analyse(pattern, factor * points + shift)
        assert other.layout == plan.layout
        np.testing.assert_array_equal(other.indices, plan.indices)


def test_a_plan_is_shared_between_equal_trees_while_it_is_used():
    gc.freeze()  # existing objects do not matter and would slow down the collection
    pattern, values, coordinates = sparse_problems.box()
    plan = analyse(pattern, coordinates)
    again = SparsityPattern.from_elements([np.stack([pattern.rows, pattern.columns], 1)[pattern.size :]], pattern.size)
    shared = analyse(again, coordinates)
    assert shared.indices is plan.indices
    assert analyse(pattern, coordinates[:, ::-1] * [1.0, 2.0, 3.0]).indices is not plan.indices
    kept = weakref.ref(plan.indices)
    del plan, shared
    gc.collect()
    gc.unfreeze()
    assert kept() is None
    plan, values = on_host((analyse(pattern, coordinates), values))
    vector = np.arange(1.0, pattern.size + 1)
    expected = np.linalg.solve(dense(pattern, values), vector)
    np.testing.assert_allclose(solve(plan, factorise(plan, values), vector), expected, rtol=1e-12)


def test_patterns_with_equal_trees_but_other_entries_share_no_plan():
    """They have the same elimination order in one front, but their values are read from other positions."""
    size, random = 12, np.random.default_rng(0)
    row, column = np.tril_indices(size, -1)
    kept = []
    for near in (row - column < size, row - column < 2):
        matrix = np.zeros((size, size))
        matrix[row[near], column[near]] = random.uniform(-1, 1, near.sum())
        matrix += matrix.T + 2 * size * np.eye(size)
        pattern, values = SparsityPattern.from_matrix(matrix)
        kept.append(analyse(pattern, np.arange(size, dtype=float)[:, None]))
        plan, values = on_host((kept[-1], values))
        solution = solve(plan, factorise(plan, values), np.arange(1.0, size + 1))
        np.testing.assert_allclose(matrix @ solution, np.arange(1.0, size + 1), rtol=1e-12)
