"""Both solvers through lineax, transform by transform, against dense algebra."""

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import sparse_problems

from jeit_solvers import ConjugateGradient, SparseCholesky, SparseSymmetric, analyse, factorise, quadratic_form, solve

CASES = [
    ("direct", "float64"),
    ("direct", "complex128"),
    ("iterative", "float64"),
    ("iterative", "complex128"),
]


@pytest.fixture(params=CASES, ids="-".join)
def functions(request):
    """Sparse and dense versions of x(values, vector), a point, and a direction."""
    route, dtype = request.param
    # Two stages of fronts: as small as a system can be that exercises everything.
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    if dtype == "complex128":
        values = values * (1 + 0.3j)
    solver = SparseCholesky(analyse(pattern, coordinates)) if route == "direct" else ConjugateGradient(1e-14)

    @jax.jit
    def sparse(values, vector):
        return lineax.linear_solve(SparseSymmetric(values, pattern), vector, solver).value

    def dense(values, vector):
        return jnp.linalg.solve(pattern.to_dense(values), vector)

    keys = jax.random.split(jax.random.key(0), 4)
    point = values, jax.random.normal(keys[0], (pattern.size,), dtype)
    direction = (
        0.1 * values * jax.random.normal(keys[1], values.shape),
        jax.random.normal(keys[2], (pattern.size,), dtype),
    )
    return sparse, dense, point, direction


def assert_close(actual, expected, tolerance=1e-9):
    """To 1e-9 of the largest number: derivatives multiply the condition number, about 1e4, into the roundoff."""
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, e, rtol=0, atol=tolerance * abs(e).max())


def test_value_and_jvp(functions):
    sparse, dense, point, direction = functions
    assert_close(jax.jvp(sparse, point, direction), jax.jvp(dense, point, direction))


def test_vjp_and_adjointness(functions):
    sparse, dense, point, direction = functions
    weights = direction[1]
    pulled = jax.vjp(sparse, *point)[1](weights)
    assert_close(pulled, jax.vjp(dense, *point)[1](weights))
    forward = weights @ jax.jvp(sparse, point, direction)[1]
    backward = sum(c @ d for c, d in zip(pulled, direction, strict=True))
    assert abs(forward - backward) < 1e-12 * max(1.0, abs(forward))


def test_hessian_product(functions):
    sparse, dense, point, direction = functions

    def gradient(function):
        return jax.grad(lambda *xs: jnp.sum(jnp.sin(function(*xs))).real, argnums=(0, 1))

    assert_close(jax.jvp(gradient(sparse), point, direction)[1], jax.jvp(gradient(dense), point, direction)[1], 1e-8)


def test_vmap_over_matrices_and_right_hand_sides(functions):
    sparse, dense, (values, vector), (other_values, other_vector) = functions
    matrices, vectors = jnp.stack([values, values + other_values]), jnp.stack([vector, other_vector])
    for axes in ((0, None), (None, 0)):
        arguments = (matrices if axes[0] == 0 else values, vectors if axes[1] == 0 else vector)
        assert_close(jax.vmap(sparse, axes)(*arguments), jax.vmap(dense, axes)(*arguments))


def test_vmap_of_jvp(functions):
    sparse, dense, point, direction = functions
    directions = jax.tree.map(lambda d: jnp.stack([d, -2 * d, d**2]), direction)

    def pushforwards(function):
        return jax.vmap(lambda d: jax.jvp(function, point, d)[1])(directions)

    assert_close(pushforwards(sparse), pushforwards(dense))


def test_factorisation_itself_is_differentiable():
    points, cells = sparse_problems.disk_cells(30)
    pattern, values, _ = sparse_problems.from_cells(points, cells)
    plan = analyse(pattern, points)
    vectors = jax.random.normal(jax.random.key(0), (pattern.size, 2))

    def sparse(values):
        factor = factorise(plan, values)
        return jnp.sum(solve(plan, factor, vectors) ** 2) + jnp.sum(quadratic_form(plan, factor, vectors))

    def dense(values):
        solution = jnp.linalg.solve(pattern.to_dense(values), vectors)
        return jnp.sum(solution**2) + jnp.sum(vectors.T @ solution)

    assert_close(jax.jit(jax.grad(sparse))(values), jax.grad(dense)(values))


def test_state_is_reused():
    pattern, values, coordinates = sparse_problems.from_cells(*sparse_problems.disk_cells(30))
    operator, solver = SparseSymmetric(values, pattern), SparseCholesky(analyse(pattern, coordinates))
    initialise = jax.jit(lambda values: solver.init(SparseSymmetric(values, pattern), {}))
    state = initialise(values)
    vector = jnp.arange(1.0, pattern.size + 1)
    reused = lineax.linear_solve(operator, vector, solver, state=state).value
    # The state is what solves: with another matrix's factor the answer is the other matrix's.
    doubled = lineax.linear_solve(operator, vector, solver, state=initialise(2 * values))
    np.testing.assert_allclose(doubled.value, reused / 2, rtol=1e-12)
