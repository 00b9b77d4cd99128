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
    ConjugateGradient,
    SparseCholesky,
    SparseSymmetric,
    SparsityPattern,
    analyse,
    choose_solver,
    factorise,
    half_solve,
    inverse_entries,
    inverse_root,
    quadratic_form,
    solve,
)
from jeit_solvers.engines import on_device, on_host

# Residuals relative to |A| |x|; a backward stable solver reaches a small multiple of the unit roundoff.
TOLERANCE = {"float32": 3e-6, "float64": 5e-15, "complex128": 5e-15}


def as_type(values, dtype):
    if dtype == "complex128":
        # Any symmetric imaginary part will do; this one is not a multiple of the real part.
        rng = np.random.default_rng(5)
        return values + 0.5j * values * jnp.asarray(rng.uniform(-1, 1, values.shape))
    return values.astype(dtype)


ALL_TYPES = ("disk",)
SOLVED = [
    (case, dtype)
    for case in sparse_problems.PROBLEMS
    for dtype in TOLERANCE
    if dtype == "float64" or case.__name__ in ALL_TYPES
]


@jax.jit
def everything(plan, values, vectors):
    factor = factorise(plan, values)
    form, half = quadratic_form(plan, factor, vectors), half_solve(plan, factor, vectors)
    return factor.positive_definite, solve(plan, factor, vectors), form, half


@pytest.mark.parametrize(("case", "dtype"), SOLVED, ids=lambda value: getattr(value, "__name__", value))
def test_solves_every_problem_to_roundoff(case, dtype):
    pattern, values, coordinates = case()
    values = as_type(values, dtype)
    plan = analyse(pattern, coordinates)
    vectors = jax.device_put(np.random.default_rng(0).normal(size=(pattern.size, 5)).astype(dtype))
    positive_definite, solution, form, half = everything(plan, values, vectors)
    assert positive_definite
    assert solution.dtype == values.dtype
    matrix, solution, form, half, vectors = map(np.asarray, (dense(pattern, values), solution, form, half, vectors))
    residual = np.linalg.norm(matrix @ solution - vectors) / np.linalg.norm(matrix) / np.linalg.norm(solution)
    assert residual < TOLERANCE[dtype]
    # Forward errors may be larger, by the condition numbers, which are below 1e3.
    loose = 1e3 * TOLERANCE[dtype]
    np.testing.assert_allclose(form, vectors.T @ solution, rtol=0, atol=loose * abs(form).max())
    np.testing.assert_allclose(half.T @ half, form, rtol=0, atol=loose * abs(form).max())


def entries_and_root(plan, values, rows):
    factor = factorise(plan, values)
    return inverse_entries(plan, factor), inverse_root(plan, factor, rows)


@pytest.mark.parametrize("engine", [on_host, on_device], ids=["numpy", "jax"])
@pytest.mark.parametrize("case", sparse_problems.PROBLEMS, ids=lambda case: case.__name__)
def test_entries_and_root_of_the_inverse_are_those_of_the_dense_one(case, engine):
    pattern, values, coordinates = case()
    inverse = np.linalg.inv(dense(pattern, values))
    pattern, plan, values = engine((pattern, analyse(pattern, coordinates), values))
    work = entries_and_root if engine is on_host else jax.jit(entries_and_root)
    entries, root = work(plan, values, engine(np.eye(plan.num_pivots)))
    assert isinstance(entries, np.ndarray) == (engine is on_host)
    least = 1e-12 * abs(inverse).max()
    np.testing.assert_allclose(
        entries, inverse[np.asarray(pattern.rows), np.asarray(pattern.columns)], rtol=0, atol=least
    )
    root = np.asarray(root)
    np.testing.assert_allclose(root @ root.T, inverse, rtol=0, atol=least)


def test_the_inverse_has_entries_where_elements_have_nodes():
    points, cells = sparse_problems.disk_cells(30)
    pattern, values, _ = sparse_problems.from_cells(points, cells)
    inverse = np.linalg.inv(dense(pattern, values))
    plan = analyse(pattern, points)
    between = pattern.entries_between(inverse_entries(plan, factorise(plan, values)))
    row, column = np.tril_indices(3)
    np.testing.assert_allclose(between, inverse[cells[:, row], cells[:, column]].T, rtol=1e-11)


def test_roots_are_refused_of_rows_of_another_order():
    pattern, values, coordinates = sparse_problems.disk()
    plan = analyse(pattern, coordinates)
    with pytest.raises(ValueError, match="inverse_root: rows"):
        inverse_root(plan, factorise(plan, values), jnp.ones((plan.num_pivots + 1, 2)))


def test_agrees_with_superlu_on_a_large_disk():
    points, cells = sparse_problems.disk_cells(1500)
    pattern, values, _ = sparse_problems.from_cells(points, cells)
    vectors = np.random.default_rng(0).standard_normal((pattern.size, 3))
    expected = splu(pattern.to_scipy(values).tocsc()).solve(vectors)
    plan = analyse(pattern, points)
    solution = jax.jit(lambda p, v, b: solve(p, factorise(p, v), b))(plan, values, jnp.asarray(vectors))
    np.testing.assert_allclose(solution, expected, rtol=0, atol=1e-12 * abs(expected).max())


def test_one_vector_is_a_column_and_jit_equals_eager():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    plan = analyse(pattern, coordinates)
    vectors = jax.random.normal(jax.random.key(0), (pattern.size, 5))
    _, solution, _, _ = everything(plan, values, vectors)
    eager = solve(plan, factorise(plan, values), vectors[:, 0])
    np.testing.assert_allclose(eager, solution[:, 0], rtol=0, atol=1e-13 * abs(eager).max())


def test_one_executable_serves_all_values():
    pattern, values, coordinates = sparse_problems.disk()
    plan = analyse(pattern, coordinates)
    jitted = jax.jit(factorise)
    jitted(plan, values)
    jitted(analyse(pattern, coordinates), 2 * values)  # another plan, equal in structure
    assert jitted._cache_size() == 1


def test_batches_of_matrices_equal_a_loop():
    pattern, values, coordinates = sparse_problems.disk()
    plan = analyse(pattern, coordinates)
    scales = jnp.asarray(np.random.default_rng(0).uniform(0.5, 2.0, (4, pattern.num_entries)))
    batch = values * (1 + 0.1 * scales)
    vectors = jax.random.normal(jax.random.key(1), (pattern.size, 2))
    both = jax.jit(lambda p, v, b: solve(p, factorise(p, v), b))
    together = jax.vmap(both, in_axes=(None, 0, None))(plan, batch, vectors)
    for values_, solution in zip(batch, together, strict=True):
        np.testing.assert_allclose(solution, both(plan, values_, vectors), rtol=0, atol=1e-12 * abs(solution).max())


@pytest.mark.parametrize("change", ["negative_pivot", "singular", "nan"])
@pytest.mark.parametrize("dtype", ["float64", "complex128"])
def test_matrices_that_are_not_positive_definite_are_refused(change, dtype):
    pattern, values, points = sparse_problems.disk()
    index, value = {"negative_pivot": (7, -5.0), "singular": (7, 0.0), "nan": (3, np.nan)}[change]
    values = as_type(values, dtype).at[index].set(value)
    plan = analyse(pattern, points)
    factor = jax.jit(factorise)(plan, values)
    assert not factor.positive_definite
    with pytest.raises(ValueError, match=r"not positive definite.*boundary condition"):
        factor.require_positive_definite()
    operator, vector = SparseSymmetric(values, pattern), jnp.ones(pattern.size, dtype)
    solution = lineax.linear_solve(operator, vector, SparseCholesky(plan), throw=False)
    assert solution.result == lineax.RESULTS.singular


def test_lineax_throws_on_an_indefinite_matrix():
    pattern, values, coordinates = sparse_problems.chain()
    solver = SparseCholesky(analyse(pattern, coordinates))
    with pytest.raises(Exception, match="positive definiteness"):
        lineax.linear_solve(SparseSymmetric(-values, pattern), jnp.ones(pattern.size), solver)


def test_batch_tells_which_matrix_failed():
    pattern, values, coordinates = sparse_problems.disk()
    plan = analyse(pattern, coordinates)
    batch = jnp.stack([values, values.at[0].set(-1.0), 2 * values])
    factors = jax.jit(jax.vmap(factorise, in_axes=(None, 0)))(plan, batch)
    verdict = jax.vmap(lambda factor: factor.positive_definite)(factors)
    assert verdict.tolist() == [True, False, True]


def test_choice_follows_the_limits_and_says_why():
    pattern, values, coordinates = sparse_problems.box()
    vector = jnp.ones(pattern.size)
    direct = choose_solver(pattern, coordinates)
    assert isinstance(direct, SparseCholesky)
    assert direct.reason.startswith("direct: ")
    little_memory = choose_solver(pattern, coordinates, memory_limit=1e3)
    assert isinstance(little_memory, ConjugateGradient)
    assert "MB allowed" in little_memory.reason
    little_time = choose_solver(pattern, coordinates, operations_limit=1e3)
    assert isinstance(little_time, ConjugateGradient)
    assert "operations allowed" in little_time.reason
    operator = SparseSymmetric(values, pattern)
    expected = lineax.linear_solve(operator, vector, direct).value
    np.testing.assert_allclose(lineax.linear_solve(operator, vector, little_time).value, expected, rtol=1e-7)


def test_nested_batches_and_gradients_of_batches():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    plan = analyse(pattern, coordinates)
    batch = values * jnp.linspace(1.0, 2.0, 6).reshape(2, 3, 1)
    vectors = jax.random.normal(jax.random.key(2), (4, pattern.size))

    def energy(values, vector):
        return vector @ solve(plan, factorise(plan, values), vector)

    def dense_energy(values, vector):
        return vector @ jnp.linalg.solve(pattern.to_dense(values), vector)

    def everywhere(function):
        over_vectors = jax.vmap(function, in_axes=(None, 0))
        return jax.jit(jax.vmap(jax.vmap(over_vectors, in_axes=(0, None)), in_axes=(0, None)))(batch, vectors)

    np.testing.assert_allclose(everywhere(energy), everywhere(dense_energy), rtol=1e-11)
    np.testing.assert_allclose(
        everywhere(jax.grad(energy)), everywhere(jax.grad(dense_energy)), rtol=0, atol=1e-9 * abs(vectors).max() ** 2
    )


def test_the_order_of_elimination_hangs_neither_on_size_nor_place():
    """Nor on what rounding makes of equal coordinates: a body twice as large has the same plan, and compiled code."""
    points = np.stack(np.meshgrid(np.arange(24.0), np.arange(24.0)), axis=-1).reshape(-1, 2)
    corner = (np.arange(23)[:, None] * 24 + np.arange(23)).ravel()
    cells = np.concatenate([corner[:, None] + [0, 1, 25], corner[:, None] + [0, 25, 24]])
    pattern = SparsityPattern.from_elements([cells], len(points))
    plan = analyse(pattern, points)
    for factor, shift in ((0.05, 0.0), (0.06, 0.0), (1 / 3, 0.7), (1.0, -11.1)):
        other = analyse(pattern, factor * points + shift)
        assert other.layout == plan.layout
        np.testing.assert_array_equal(other.indices, plan.indices)


def test_a_plan_serves_all_that_have_its_tree_while_any_uses_it():
    pattern, values, coordinates = sparse_problems.box()
    plan = analyse(pattern, coordinates)
    again = SparsityPattern.from_elements([np.stack([pattern.rows, pattern.columns], 1)[pattern.size :]], pattern.size)
    shared = analyse(again, coordinates)
    assert shared.indices is plan.indices
    assert analyse(pattern, coordinates[:, ::-1] * [1.0, 2.0, 3.0]).indices is not plan.indices
    kept = weakref.ref(plan.indices)
    del plan, shared
    gc.collect()
    assert kept() is None
    plan = analyse(pattern, coordinates)
    vector = np.arange(1.0, pattern.size + 1)
    expected = np.linalg.solve(dense(pattern, values), vector)
    np.testing.assert_allclose(solve(plan, factorise(plan, values), jnp.asarray(vector)), expected, rtol=1e-12)


def test_patterns_of_one_tree_but_other_entries_share_no_plan():
    """Eliminated in the same order, all in one front, but read from other places."""
    size, random = 12, np.random.default_rng(0)
    row, column = np.tril_indices(size, -1)
    kept = []
    for near in (row - column < size, row - column < 2):
        matrix = np.zeros((size, size))
        matrix[row[near], column[near]] = random.uniform(-1, 1, near.sum())
        matrix += matrix.T + 2 * size * np.eye(size)
        pattern, values = SparsityPattern.from_matrix(matrix)
        kept.append(analyse(pattern, np.arange(size, dtype=float)[:, None]))
        solution = solve(kept[-1], factorise(kept[-1], values), jnp.arange(1.0, size + 1))
        np.testing.assert_allclose(matrix @ solution, np.arange(1.0, size + 1), rtol=1e-12)
