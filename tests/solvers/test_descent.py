"""The ridge step against dense algebra, and the descent with it against optimistix's own Levenberg-Marquardt."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jeit_solvers import Descent, ridge_model, ridge_step, solve_definite

KEY = jax.random.key(3)


def correlated(size):
    """A covariance far from the identity, and its inverse."""
    root = jax.random.normal(jax.random.key(9), (size, size))
    covariance = root @ root.T + 0.1 * jnp.eye(size)
    return covariance, jnp.linalg.inv(covariance)


def uncorrelated(size):
    return jnp.eye(size), jnp.eye(size)


@pytest.mark.parametrize("noise", [correlated, uncorrelated])
@pytest.mark.parametrize("shape", [(5, 40), (40, 5), (30, 30)])
def test_ridge_step_in_either_space(shape, noise):
    covariance, precision = noise(shape[0])
    jacobian = jax.random.normal(KEY, shape)
    residual, point = jax.random.normal(KEY, (shape[0],)), jax.random.normal(KEY, (shape[1],))
    expected = np.linalg.solve(
        jacobian.T @ precision @ jacobian + 1.5 * np.eye(shape[1]), -(jacobian.T @ precision @ residual + point)
    )
    step = ridge_step(jacobian, residual, point, covariance, precision, 1.5)
    np.testing.assert_allclose(step, expected, rtol=1e-9, atol=1e-11)


def test_ridge_step_where_the_ridge_is_tiny():
    jacobian = 1e6 * jax.random.normal(KEY, (5, 40))
    residual = jax.random.normal(KEY, (5,))
    expected = -np.linalg.pinv(np.asarray(jacobian)) @ residual
    step = ridge_step(jacobian, residual, jnp.zeros(40), *uncorrelated(5))
    np.testing.assert_allclose(step, expected, rtol=1e-9, atol=1e-16)


def test_solve_definite():
    covariance, precision = correlated(70)
    vector = jax.random.normal(KEY, (70,))
    np.testing.assert_allclose(solve_definite(covariance, vector), precision @ vector, rtol=1e-8)
    assert np.isnan(solve_definite(-covariance, vector)).any()


def misfit(c, matrix):
    return jnp.arctan(matrix @ c) + 0.3 * jnp.sin(c[: matrix.shape[0]]) - 0.8


def residual(c, matrix):
    return misfit(c, matrix), c


def expand(c, matrix):
    return ridge_model(misfit(c, matrix), jax.jacfwd(misfit)(c, matrix), c, *uncorrelated(matrix.shape[0]))


def minimise(solver, start, matrix, **options):
    return optx.least_squares(residual, solver, start, matrix, options=options, max_steps=60, throw=False)


def test_the_model_along_its_step():
    """Slope and curvature are those of the cost, for a residual that is linear."""
    covariance, precision = correlated(6)
    matrix, point = jax.random.normal(KEY, (6, 9)), jnp.arange(9.0)

    def cost_at(c):
        return ridge_model(matrix @ c - 1, matrix, c, covariance, precision)[0]

    cost, step = ridge_model(matrix @ point - 1, matrix, point, covariance, precision)
    direction, slope, curvature = step(0.7)
    assert float(cost) == pytest.approx(float(cost_at(point)), rel=1e-12)
    for scale in (0.3, 1.0):
        expected = cost + scale * slope + scale**2 * curvature / 2
        assert float(cost_at(point + scale * direction)) == pytest.approx(float(expected), rel=1e-10)


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_same_minimum_as_optimistix(damping):
    matrix = jax.random.normal(KEY, (6, 9))
    start = jnp.full(9, 2.0)
    found = minimise(Descent(rtol=1e-14, damping=damping), start, matrix, expand=expand)
    expected = minimise(optx.LevenbergMarquardt(1e-12, 1e-12), start, matrix)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, expected.value, atol=1e-6)
    costs = np.asarray(found.state.history[: int(found.state.num_accepted)])
    assert (np.diff(costs) < 0).all()


def test_a_linear_problem_takes_one_gauss_newton_step():
    matrix = jax.random.normal(KEY, (4, 12))
    noise = correlated(4)
    data = jnp.arange(4.0)

    def linear(c, data):
        return ridge_model(matrix @ c - data, matrix, c, *noise)

    solution = optx.least_squares(
        lambda c, y: (matrix @ c - y, c), Descent(), jnp.zeros(12), data, options={"expand": linear}
    )
    assert int(solution.state.num_accepted) == 2
    np.testing.assert_allclose(solution.value, ridge_step(matrix, -data, jnp.zeros(12), *noise), rtol=1e-9)


def test_a_start_that_cannot_be_evaluated_is_said_so():
    matrix = jax.random.normal(KEY, (6, 9))
    solution = minimise(Descent(), jnp.full(9, jnp.nan), matrix, expand=expand)
    assert solution.result != optx.RESULTS.successful


def test_batches_give_what_a_loop_gives():
    matrices = jax.random.normal(KEY, (3, 6, 9))

    def run(matrix):
        return minimise(Descent(rtol=1e-12), jnp.zeros(9), matrix, expand=expand).value

    np.testing.assert_allclose(jax.vmap(run)(matrices), jnp.stack([run(m) for m in matrices]), atol=1e-10)


def test_the_expansion_is_asked_for():
    with pytest.raises(ValueError, match="expand"):
        minimise(Descent(), jnp.zeros(9), jax.random.normal(KEY, (6, 9)))
