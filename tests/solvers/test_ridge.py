"""The ridge solver against dense algebra and against optimistix's own Levenberg-Marquardt."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jeit_solvers import RidgeSolver, ridge_step

KEY = jax.random.key(3)


@pytest.mark.parametrize("shape", [(5, 40), (40, 5), (30, 30)])
def test_ridge_step_in_either_space(shape):
    jacobian = jax.random.normal(KEY, shape)
    residual, point = jax.random.normal(KEY, (shape[0],)), jax.random.normal(KEY, (shape[1],))
    expected = np.linalg.solve(jacobian.T @ jacobian + 1.5 * np.eye(shape[1]), -(jacobian.T @ residual + point))
    np.testing.assert_allclose(ridge_step(jacobian, residual, point, 1.5), expected, rtol=1e-10, atol=1e-12)


def test_ridge_step_where_the_ridge_is_tiny():
    jacobian = 1e6 * jax.random.normal(KEY, (5, 40))
    residual = jax.random.normal(KEY, (5,))
    expected = -np.linalg.pinv(np.asarray(jacobian)) @ residual
    np.testing.assert_allclose(ridge_step(jacobian, residual, jnp.zeros(40)), expected, rtol=1e-9, atol=1e-16)


def misfit(c, matrix):
    return jnp.arctan(matrix @ c) + 0.3 * jnp.sin(c[: matrix.shape[0]]) - 0.8


def residual(c, matrix):
    return misfit(c, matrix), c


def linearise(c, matrix):
    return misfit(c, matrix), jax.jacfwd(misfit)(c, matrix)


def minimise(solver, start, matrix, **options):
    return optx.least_squares(residual, solver, start, matrix, options=options, max_steps=60, throw=False)


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_same_minimum_as_optimistix(damping):
    matrix = jax.random.normal(KEY, (6, 9))
    start = jnp.full(9, 2.0)
    found = minimise(RidgeSolver(rtol=1e-14, damping=damping), start, matrix, linearise=linearise)
    expected = minimise(optx.LevenbergMarquardt(1e-12, 1e-12), start, matrix)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, expected.value, atol=1e-6)
    costs = np.asarray(found.state.history[: int(found.state.num_accepted)])
    assert (np.diff(costs) < 0).all()


def test_a_linear_problem_takes_one_gauss_newton_step():
    matrix = jax.random.normal(KEY, (4, 12))

    def linear(c, data):
        return matrix @ c - data, matrix

    data = jnp.arange(4.0)
    solution = optx.least_squares(
        lambda c, y: (matrix @ c - y, c), RidgeSolver(), jnp.zeros(12), data, options={"linearise": linear}
    )
    assert int(solution.state.num_accepted) == 2
    np.testing.assert_allclose(solution.value, ridge_step(matrix, -data, jnp.zeros(12)), rtol=1e-9)


def test_a_start_that_cannot_be_evaluated_is_said_so():
    matrix = jax.random.normal(KEY, (6, 9))
    solution = minimise(RidgeSolver(), jnp.full(9, jnp.nan), matrix, linearise=linearise)
    assert solution.result != optx.RESULTS.successful


def test_batches_give_what_a_loop_gives():
    matrices = jax.random.normal(KEY, (3, 6, 9))

    def run(matrix):
        return minimise(RidgeSolver(rtol=1e-12), jnp.zeros(9), matrix, linearise=linearise).value

    np.testing.assert_allclose(jax.vmap(run)(matrices), jnp.stack([run(m) for m in matrices]), atol=1e-10)


def test_the_linearisation_is_asked_for():
    with pytest.raises(ValueError, match="linearise"):
        minimise(RidgeSolver(), jnp.zeros(9), jax.random.normal(KEY, (6, 9)))
