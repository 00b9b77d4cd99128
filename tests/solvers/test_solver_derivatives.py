"""Both solvers with lineax in every transformation, against the derivatives of A⁻¹b in closed form.

With x = A⁻¹b: dx = A⁻¹(db − dA x). For weights w of x and λ = A⁻¹w, the derivative in entry (i, j) is −(λ_i x_j + λ_j
x_i), in a diagonal entry −λ_i x_i, and in b it is λ. There is no conjugation, so this holds for complex numbers, too.
"""

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import sparse_problems

from jeit_solvers import ConjugateGradient, SparseCholesky, SparseSymmetric, analyse, factorise, quadratic_form, solve

# Each solver and each number type once; the other pairs are slow.
CASES = [
    pytest.param(("direct", "float64"), id="direct-float64"),
    pytest.param(("direct", "complex128"), id="direct-complex128", marks=pytest.mark.slow),
    pytest.param(("iterative", "float64"), id="iterative-float64", marks=pytest.mark.slow),
    pytest.param(("iterative", "complex128"), id="iterative-complex128"),
]


@pytest.fixture(params=CASES, scope="module")
def case(request):
    """x(values, vector), the pattern, a point, and a direction."""
    route, dtype = request.param
    # Two stages of fronts: the smallest system that uses every part of the solver.
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    values, random = np.asarray(values), np.random.default_rng(0)
    if dtype == "complex128":
        values = values * (1 + 0.3j)
    solver = SparseCholesky(analyse(pattern, coordinates)) if route == "direct" else ConjugateGradient(1e-14)

    def solution(values, vector):
        return lineax.linear_solve(SparseSymmetric(values, pattern), vector, solver).value

    def normal(size):
        drawn = random.normal(size=(2, size))
        return drawn[0] + 1j * drawn[1] if dtype == "complex128" else drawn[0]

    point = values, normal(pattern.size)
    return solution, pattern, point, (0.1 * values * random.normal(size=values.shape), normal(pattern.size))


def closed_form(pattern, point, direction):
    """x, dx, and a function of weights and their change that returns the derivative in values and vector, and its
    change."""
    rows, columns = np.asarray(pattern.rows), np.asarray(pattern.columns)
    matrix, change = (sparse_problems.dense(pattern, one[0]) for one in (point, direction))
    x = np.linalg.solve(matrix, point[1])
    dx = np.linalg.solve(matrix, direction[1] - change @ x)
    share = np.where(rows == columns, 0.5, 1.0)

    def between(one, other):
        return -(one[rows] * other[columns] + one[columns] * other[rows]) * share

    def pulled(weights, changed):
        dual = np.linalg.solve(matrix, weights)
        turned = np.linalg.solve(matrix, changed - change @ dual)
        return (between(dual, x), dual), (between(turned, x) + between(dual, dx), turned)

    return x, dx, pulled


def assert_close(actual, expected, tolerance=1e-9):
    """To 1e-9 of the largest number, because derivatives multiply the roundoff by the condition number of about 1e4."""
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, e, rtol=0, atol=tolerance * abs(e).max())


def test_derivatives_in_forward_and_reverse_mode_and_of_a_gradient(case):
    """The value, its derivative in a direction, weighted derivatives, and a product with the Hessian, in one
    program."""
    solution, pattern, point, direction = case
    x, dx, pulled = closed_form(pattern, point, direction)
    weights = direction[1]

    def gradient(*point):
        return jax.grad(lambda *xs: jnp.sum(jnp.sin(solution(*xs))).real, argnums=(0, 1))(*point)

    @jax.jit
    def everything(point, direction):
        value, pull = jax.vjp(solution, *point)
        pushed = jax.jvp(solution, point, direction)
        return value, pushed, pull(weights), jax.jvp(gradient, point, direction)

    value, pushed, back, (slope, curved) = everything(point, direction)
    assert_close(value, x)
    assert_close(pushed, (x, dx))
    assert_close(back, pulled(weights, 0 * weights)[0])
    forward, backward = (
        weights @ np.asarray(pushed[1]),
        sum(np.asarray(c) @ d for c, d in zip(back, direction, strict=True)),
    )
    assert abs(forward - backward) < 1e-12 * max(1.0, abs(forward))
    expected = pulled(np.cos(x), -np.sin(x) * dx)
    assert_close(slope, expected[0])
    assert_close(curved, expected[1], 1e-8)


def test_batches_of_matrices_right_hand_sides_and_directions(case):
    solution, pattern, (values, vector), (other_values, other_vector) = case
    matrices, vectors = np.stack([values, values + other_values]), np.stack([vector, other_vector])
    ways = [(by * other_values, by * other_vector) for by in (1.0, -2.0)] + [(other_values**2, other_vector**2)]
    stacked = tuple(np.stack(parts) for parts in zip(*ways, strict=True))

    @jax.jit
    def everything(matrices, vectors, ways):
        pushed = jax.vmap(lambda way: jax.jvp(solution, (values, vector), way)[1])(ways)
        return *(
            jax.vmap(solution, axes)(*of)
            for axes, of in (((0, None), (matrices, vector)), ((None, 0), (values, vectors)))
        ), pushed

    of_matrices, of_vectors, pushed = everything(matrices, vectors, stacked)
    assert_close(
        of_matrices, np.stack([np.linalg.solve(sparse_problems.dense(pattern, one), vector) for one in matrices])
    )
    assert_close(of_vectors, np.linalg.solve(sparse_problems.dense(pattern, values), vectors.T).T)
    assert_close(pushed, np.stack([closed_form(pattern, (values, vector), way)[1] for way in ways]))


def test_factorisation_itself_is_differentiable():
    """The sum of the squares of X = A⁻¹B and of the entries of BᵀX, in a direction dA: dX = −A⁻¹ dA X."""
    points, cells = sparse_problems.disk_cells(30)
    pattern, values, _ = sparse_problems.from_cells(points, cells)
    plan, random = analyse(pattern, points), np.random.default_rng(0)
    vectors, direction = random.normal(size=(pattern.size, 2)), random.normal(size=values.shape)

    def total(values):
        factor = factorise(plan, values)
        form = quadratic_form(plan, factor, jnp.asarray(vectors))
        return jnp.sum(solve(plan, factor, jnp.asarray(vectors)) ** 2) + jnp.sum(form)

    matrix, change = (sparse_problems.dense(pattern, one) for one in (values, direction))
    solution = np.linalg.solve(matrix, vectors)
    turned = -np.linalg.solve(matrix, change @ solution)
    expected = 2 * np.sum(solution * turned) + np.sum(vectors.T @ turned)
    assert np.asarray(jax.jit(jax.grad(total))(values)) @ direction == pytest.approx(expected, rel=1e-9)


def test_state_is_reused():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    operator, solver = SparseSymmetric(values, pattern), SparseCholesky(analyse(pattern, coordinates))
    initialise = jax.jit(lambda values: solver.init(SparseSymmetric(values, pattern), {}))
    state = initialise(values)
    vector = jnp.arange(1.0, pattern.size + 1)
    reused = lineax.linear_solve(operator, vector, solver, state=state).value
    # The solution is that of the state: with another matrix's factor it is that matrix's solution.
    doubled = lineax.linear_solve(operator, vector, solver, state=initialise(2 * values))
    np.testing.assert_allclose(doubled.value, reused / 2, rtol=1e-12)
