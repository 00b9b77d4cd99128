"""Patterns, assembly and the lineax operator against matrices assembled entry by entry, and errors for invalid
input."""

from itertools import combinations

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import sparse_problems
from scipy.sparse import csr_array

from jeit_solvers import (
    ConjugateGradient,
    SparseCholesky,
    SparseSymmetric,
    SparsityPattern,
    analyse,
    factorise,
    find_fronts,
    solve,
)


def added_up(groups, matrices, size):
    """The assembled matrix, entry by entry."""
    total = np.zeros((size, size), dtype=np.result_type(*matrices))
    for elements, blocks in zip(groups, matrices, strict=True):
        for nodes, block in zip(elements, blocks, strict=True):
            total[np.ix_(nodes, nodes)] += block
    return total


def test_numbers_of_entries_of_fronts_and_factor():
    """Counts by which a direct or an iterative solver is chosen."""
    points, cells = sparse_problems.disk_cells(300)
    pattern = SparsityPattern.from_elements([cells], 300)
    fronts = find_fronts(pattern, points)
    edges = {tuple(sorted(pair)) for cell in cells.tolist() for pair in combinations(cell, 2)}
    assert fronts.num_factor_entries >= 300 + len(edges)
    assert fronts.num_operations >= 2 * fronts.num_factor_entries
    children = fronts.fronts[-1].children
    assert fronts.num_waiting_entries >= sum(fronts.fronts[child].border ** 2 for child in children) > 0


@pytest.fixture
def groups():
    _, cells = sparse_problems.disk_cells(80)
    facets = np.random.default_rng(0).permuted(np.tile(np.arange(80), (20, 1)), axis=1)[:, :2]
    return [cells, facets]


@pytest.mark.parametrize("imaginary", [0.0, 1.0])
def test_assembly_of_groups(groups, imaginary):
    """In NumPy and in compiled code."""
    matrices = [sparse_problems.element_matrices(*group.shape) * (1 + 1j * imaginary) for group in groups]
    if not imaginary:
        matrices = [matrix.real for matrix in matrices]
    pattern = SparsityPattern.from_elements(groups, 80)
    packed = [np.stack([m[:, i, j] for i, j in zip(*np.tril_indices(m.shape[1]), strict=True)]) for m in matrices]

    @jax.jit
    def assembled(whole, packed):
        values = pattern.assemble(*whole)
        others = pattern.assemble(*packed), pattern.assemble(whole[0], None)
        return values, *others, pattern.to_dense(values), pattern.diagonal(values)

    values, of_packed, only_first, matrix, diagonal = map(np.asarray, assembled(matrices, packed))
    expected = added_up(groups, matrices, 80)
    least = 1e-14 * abs(expected).max()
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=least)
    np.testing.assert_allclose(pattern.to_scipy(values).toarray(), expected, rtol=0, atol=least)
    vectors = np.random.default_rng(0).normal(size=(pattern.size, 3))
    product = pattern.quadratic_form(np.asarray(values), vectors)
    np.testing.assert_allclose(product, vectors.T @ expected @ vectors, rtol=0, atol=20 * least)
    np.testing.assert_array_equal(diagonal, np.diag(matrix))
    np.testing.assert_array_equal(of_packed, values)
    first = added_up(groups[:1], matrices[:1], 80)
    np.testing.assert_allclose(pattern.to_scipy(only_first).toarray(), first, atol=1e-13)
    for given in (matrices, packed):
        np.testing.assert_allclose(pattern.assemble(*given), values, rtol=0, atol=least)


def test_assembly_is_linear_under_vmap_and_vjp(groups):
    pattern = SparsityPattern.from_elements(groups, 80)
    matrices = [sparse_problems.element_matrices(*group.shape) for group in groups]
    batch = [np.stack([m, 2 * m, -m]) for m in matrices]
    weights = np.random.default_rng(0).normal(size=pattern.num_entries)

    @jax.jit
    def both(batch, matrices):
        return jax.vmap(pattern.assemble)(*batch), jax.vjp(pattern.assemble, *matrices)[1](weights)

    together, pulled = jax.tree.map(np.asarray, both(batch, matrices))
    np.testing.assert_allclose(together[0], pattern.assemble(*matrices), rtol=1e-13)
    np.testing.assert_allclose(together[1], 2 * together[0], rtol=1e-14)
    inner = sum(np.vdot(p, m) for p, m in zip(pulled, matrices, strict=True))
    np.testing.assert_allclose(inner, weights @ together[0], rtol=1e-12)


def test_operator_agrees_with_its_dense_matrix():
    pattern, values, _ = sparse_problems.disk()
    vector = np.random.default_rng(0).normal(size=pattern.size)
    operator, complex_operator = SparseSymmetric(values, pattern), SparseSymmetric(1j * np.asarray(values), pattern)
    assert lineax.is_symmetric(operator)
    assert lineax.is_positive_semidefinite(operator)
    assert not lineax.is_positive_semidefinite(complex_operator)

    @jax.jit
    def all_of(operator, complex_operator):
        conjugate = lineax.conj(complex_operator).as_matrix()
        return operator.as_matrix(), operator.mv(jnp.asarray(vector)), lineax.diagonal(operator), conjugate

    dense, product, diagonal, conjugate = map(np.asarray, all_of(operator, complex_operator))
    np.testing.assert_array_equal(dense, sparse_problems.dense(pattern, values))
    np.testing.assert_allclose(product, dense @ vector, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(dense, dense.T)
    np.testing.assert_array_equal(diagonal, np.diagonal(dense))
    np.testing.assert_array_equal(conjugate, -1j * dense)


def test_conjugate_solves_the_conjugate_system():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    values, vector = np.asarray(values) * (1 + 0.4j), np.arange(1.0, pattern.size + 1) + 0j
    for solver in (SparseCholesky(analyse(pattern, coordinates)), ConjugateGradient(1e-13)):

        @jax.jit
        def solution(values, vector, solver=solver):
            state, _ = solver.conj(solver.init(SparseSymmetric(values, pattern), {}), {})
            return solver.compute(state, vector, {})[0]

        residual = sparse_problems.dense(pattern, values.conj()) @ solution(values, vector) - vector
        assert np.linalg.norm(residual) < 1e-11 * np.linalg.norm(vector)


def test_from_entries_keeps_the_given_order_and_adds_duplicates():
    pattern = SparsityPattern.from_entries([0, 2, 1, 0, 2, 1], [0, 2, 1, 1, 0, 1], 3)
    values = pattern.assemble(np.array([4.0, 5.0, 6.0, 0.1, 0.2, 0.5]))
    np.testing.assert_allclose(
        pattern.to_scipy(values).toarray(), [[4, 0.1, 0.2], [0.1, 6.5, 0], [0.2, 0, 5]], rtol=1e-15
    )


def test_iterative_solver_reports_its_failures():
    pattern, values, _ = sparse_problems.disk()

    @jax.jit
    def solved(values, vector):
        solver = ConjugateGradient(1e-12, max_steps=3)
        return lineax.linear_solve(SparseSymmetric(values, pattern), vector, solver, throw=False)

    vector, indefinite = np.ones(pattern.size), np.array(values)
    hurried = solved(values, vector)
    assert hurried.result == lineax.RESULTS.max_steps_reached
    assert hurried.stats["num_steps"] == 3
    indefinite[5] = -100.0
    assert solved(indefinite, np.eye(pattern.size)[5]).result == lineax.RESULTS.breakdown
    zero = solved(values, 0 * vector)
    assert zero.result == lineax.RESULTS.successful
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
