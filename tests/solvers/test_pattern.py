"""Patterns, assembly and the lineax operator."""

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import sparse_problems
from scipy.sparse import csr_array

from jeit_solvers import ConjugateGradient, SparseCholesky, SparseSymmetric, SparsityPattern, analyse, factorise, solve


def added_up(groups, matrices, size):
    """The assembled matrix, entry by entry."""
    total = np.zeros((size, size), dtype=np.result_type(*matrices))
    for elements, blocks in zip(groups, matrices, strict=True):
        for nodes, block in zip(elements, blocks, strict=True):
            total[np.ix_(nodes, nodes)] += block
    return total


@pytest.fixture
def groups():
    _, cells = sparse_problems.disk_cells(80)
    facets = np.random.default_rng(0).permuted(np.tile(np.arange(80), (20, 1)), axis=1)[:, :2]
    return [cells, facets]


@pytest.mark.parametrize("imaginary", [0.0, 1.0])
def test_assembly_adds_up_groups(groups, imaginary):
    matrices = [sparse_problems.element_matrices(*group.shape) * (1 + 1j * imaginary) for group in groups]
    if not imaginary:
        matrices = [matrix.real for matrix in matrices]
    pattern = SparsityPattern.from_elements(groups, 80)
    values = jax.jit(lambda p, *m: p.assemble(*m))(pattern, *map(jnp.asarray, matrices))
    expected = added_up(groups, matrices, 80)
    np.testing.assert_allclose(pattern.to_dense(values), expected, rtol=0, atol=1e-14 * abs(expected).max())
    np.testing.assert_allclose(pattern.to_scipy(values).toarray(), expected, rtol=0, atol=1e-14 * abs(expected).max())
    np.testing.assert_array_equal(pattern.diagonal(values), np.diag(pattern.to_dense(values)))
    packed = [jnp.stack([m[:, i, j] for i, j in zip(*np.tril_indices(m.shape[1]), strict=True)]) for m in matrices]
    np.testing.assert_array_equal(pattern.assemble(*packed), values)
    only_first = pattern.assemble(jnp.asarray(matrices[0]), None)
    np.testing.assert_allclose(pattern.to_dense(only_first), added_up(groups[:1], matrices[:1], 80), atol=1e-13)


def test_assembly_is_linear_under_vmap_and_vjp(groups):
    pattern = SparsityPattern.from_elements(groups, 80)
    matrices = [jnp.asarray(sparse_problems.element_matrices(*group.shape)) for group in groups]
    batch = [jnp.stack([m, 2 * m, -m]) for m in matrices]
    together = jax.vmap(pattern.assemble)(*batch)
    np.testing.assert_allclose(together[1], 2 * together[0], rtol=1e-14)
    weights = jax.random.normal(jax.random.key(0), (pattern.num_entries,))
    pulled = jax.vjp(pattern.assemble, *matrices)[1](weights)
    inner = sum(jnp.vdot(p, m) for p, m in zip(pulled, matrices, strict=True))
    np.testing.assert_allclose(inner, weights @ together[0], rtol=1e-12)


def test_operator_agrees_with_its_dense_matrix():
    pattern, values, _ = sparse_problems.disk()
    operator = SparseSymmetric(values, pattern)
    dense = operator.as_matrix()
    vector = jax.random.normal(jax.random.key(0), (pattern.size,))
    np.testing.assert_allclose(operator.mv(vector), dense @ vector, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(dense, dense.T)
    np.testing.assert_array_equal(lineax.diagonal(operator), jnp.diagonal(dense))
    assert lineax.is_symmetric(operator)
    assert lineax.is_positive_semidefinite(operator)
    complex_operator = SparseSymmetric(values * 1j, pattern)
    assert not lineax.is_positive_semidefinite(complex_operator)
    np.testing.assert_array_equal(lineax.conj(complex_operator).as_matrix(), -1j * dense)


def test_conjugate_solves_the_conjugate_system():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    values, vector = values * (1 + 0.4j), jnp.arange(1.0, pattern.size + 1) + 0j
    for solver in (SparseCholesky(analyse(pattern, coordinates)), ConjugateGradient(1e-13)):
        operator = SparseSymmetric(values, pattern)
        state, _ = solver.conj(jax.jit(lambda v, s=solver: s.init(SparseSymmetric(v, pattern), {}))(values), {})
        solution, _, _ = solver.compute(state, vector, {})
        residual = lineax.conj(operator).mv(solution) - vector
        assert jnp.linalg.norm(residual) < 1e-11 * jnp.linalg.norm(vector)


def test_from_entries_keeps_the_callers_order_and_adds_duplicates():
    pattern = SparsityPattern.from_entries([0, 2, 1, 0, 2, 1], [0, 2, 1, 1, 0, 1], 3)
    values = pattern.assemble(jnp.asarray([4.0, 5.0, 6.0, 0.1, 0.2, 0.5]))
    np.testing.assert_allclose(pattern.to_dense(values), [[4, 0.1, 0.2], [0.1, 6.5, 0], [0.2, 0, 5]], rtol=1e-15)


def test_iterative_solver_reports_its_failures():
    pattern, values, _ = sparse_problems.disk()
    vector = jnp.ones(pattern.size)
    hurried = lineax.linear_solve(
        SparseSymmetric(values, pattern), vector, ConjugateGradient(1e-12, max_steps=3), throw=False
    )
    assert hurried.result == lineax.RESULTS.max_steps_reached
    assert hurried.stats["num_steps"] == 3
    indefinite = lineax.linear_solve(
        SparseSymmetric(values.at[5].set(-100.0), pattern), vector, ConjugateGradient(1e-12), throw=False
    )
    assert indefinite.result == lineax.RESULTS.breakdown
    zero = lineax.linear_solve(SparseSymmetric(values, pattern), 0 * vector, ConjugateGradient(1e-12))
    np.testing.assert_array_equal(zero.value, 0 * vector)


GOOD = np.array([[0, 1, 2]])
BAD_INPUTS = {
    "no groups": (lambda: SparsityPattern.from_elements([], 3), "`groups` is empty"),
    "one-dimensional group": (lambda: SparsityPattern.from_elements([np.arange(3)], 3), "shape \\(m, k\\)"),
    "floating-point nodes": (lambda: SparsityPattern.from_elements([GOOD * 1.0], 3), "must hold integers"),
    "counted from one": (lambda: SparsityPattern.from_elements([GOOD + 1], 3), "counted from 1"),
    "negative node": (lambda: SparsityPattern.from_elements([GOOD - 1], 3), "outside 0..2"),
    "node twice": (lambda: SparsityPattern.from_elements([[[0, 1, 1]]], 2), "names a node twice"),
    "orphan node": (lambda: SparsityPattern.from_elements([GOOD], 5), "belong to no element.*\\[3, 4\\]"),
    "no rows": (lambda: SparsityPattern.from_elements([GOOD], 0), "`size` must be a positive integer"),
    "size not an integer": (lambda: SparsityPattern.from_elements([GOOD], 3.0), "`size` must be a positive integer"),
    "unequal entries": (lambda: SparsityPattern.from_entries([0, 1], [0], 2), "equally long"),
    "empty row": (lambda: SparsityPattern.from_entries([0], [0], 2), "no diagonal entry"),
    "entry out of range": (lambda: SparsityPattern.from_entries([0, 3], [0, 1], 2), "outside 0..1"),
    "not square": (lambda: SparsityPattern.from_matrix(np.ones((2, 3))), "must be square"),
    "not symmetric": (lambda: SparsityPattern.from_matrix(np.array([[1.0, 2], [0, 1]])), "not symmetric"),
    "Hermitian": (lambda: SparsityPattern.from_matrix(csr_array([[1, 1j], [-1j, 1]])), "not symmetric"),
    "NaN in matrix": (lambda: SparsityPattern.from_matrix(np.diag([1.0, np.nan])), "NaN or infinite"),
    "too few groups": (lambda: triangle().assemble(), "1 groups"),
    "nothing to assemble": (lambda: triangle().assemble(None), "nothing to assemble"),
    "wrong element shape": (lambda: triangle().assemble(jnp.ones((2, 3, 3))), "argument 0 must hold 1 symmetric"),
    "too many values": (lambda: SparseSymmetric(jnp.ones(7), triangle()), "`values` must have shape \\(6,\\)"),
    "integer values": (lambda: SparseSymmetric(jnp.ones(6, int), triangle()), "must be floating point"),
    "coordinates of others": (lambda: analyse(triangle(), np.ones((4, 2))), "`coordinates` must have shape"),
    "NaN coordinates": (lambda: analyse(triangle(), np.full((3, 2), np.nan)), "NaN or infinity"),
    "values of others": (lambda: factorise(analyse(triangle()), jnp.ones(5)), "factorise: `values` must have shape"),
    "vector of others": (
        lambda: solve(analyse(triangle()), factorise(analyse(triangle()), jnp.ones(6)), jnp.ones(4)),
        "right-hand sides must have shape",
    ),
    "plan of others": (
        lambda: SparseCholesky(analyse(triangle())).init(SparseSymmetric(*sparse_problems.chain()[1::-1]), {}),
        "the plan is for a pattern of 3 rows",
    ),
    "other operator": (
        lambda: SparseCholesky(analyse(triangle())).init(lineax.MatrixLinearOperator(jnp.eye(3)), {}),
        "`SparseSymmetric` operators only",
    ),
    "tolerance": (lambda: ConjugateGradient(2.0), "`tolerance` must be between 0 and 1"),
    "no steps": (lambda: ConjugateGradient(1e-8, max_steps=0), "`max_steps` must be positive"),
}


def triangle():
    return SparsityPattern.from_elements([GOOD], 3)


@pytest.mark.parametrize("name", BAD_INPUTS)
def test_bad_input_is_explained(name):
    attempt, message = BAD_INPUTS[name]
    with pytest.raises(ValueError, match=message):
        attempt()
