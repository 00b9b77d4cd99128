"""The ridge step against dense algebra, and the descent with it against SciPy's least squares."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares

from jeit_solvers import Descent, ridge_model, ridge_step, solve_definite


def normal(*shape, seed=3):
    return np.random.default_rng(seed).normal(size=shape)


def correlated(size):
    """A covariance far from the identity, and its inverse."""
    root = normal(size, size, seed=9)
    covariance = root @ root.T + 0.1 * np.eye(size)
    return covariance, np.linalg.inv(covariance)


def uncorrelated(size):
    return np.eye(size), np.eye(size)


compiled_step = jax.jit(ridge_step)


# More unknowns than data, fewer, and equally many.
@pytest.mark.parametrize("shape", [(5, 40), (40, 5), (30, 30)])
def test_ridge_step_in_data_and_parameter_space(shape):
    jacobian, residual, point = normal(*shape), normal(shape[0], seed=4), normal(shape[1], seed=5)
    for covariance, precision in (correlated(shape[0]), uncorrelated(shape[0])):
        expected = np.linalg.solve(
            jacobian.T @ precision @ jacobian + 1.5 * np.eye(shape[1]), -(jacobian.T @ precision @ residual + point)
        )
        step = compiled_step(jacobian, residual, point, covariance, precision, 1.5)
        np.testing.assert_allclose(step, expected, rtol=1e-9, atol=1e-11)


def test_ridge_step_with_a_tiny_ridge():
    jacobian, residual = 1e6 * normal(5, 40), normal(5, seed=4)
    expected = -np.linalg.pinv(jacobian) @ residual
    step = compiled_step(jacobian, residual, np.zeros(40), *uncorrelated(5), 1.0)
    np.testing.assert_allclose(step, expected, rtol=1e-9, atol=1e-16)


def test_solve_definite():
    covariance, precision = correlated(70)
    vector, solve = normal(70), jax.jit(solve_definite)
    np.testing.assert_allclose(solve(covariance, vector), precision @ vector, rtol=1e-8)
    assert np.isnan(solve(-covariance, vector)).any()


def misfit(c, matrix):
    return jnp.arctan(matrix @ c) + 0.3 * jnp.sin(c[: matrix.shape[0]]) - 0.8


def residual(c, matrix):
    return misfit(c, matrix), c


def expand(c, matrix):
    return ridge_model(misfit(c, matrix), jax.jacfwd(misfit)(c, matrix), c, *uncorrelated(matrix.shape[0]))


@partial(jax.jit, static_argnames=("solver", "expand"))
def minimise(solver, start, matrix, expand=None):
    options = {} if expand is None else {"expand": expand}
    return optx.least_squares(residual, solver, start, matrix, options=options, max_steps=60, throw=False)


def test_the_model_along_its_step():
    """Slope and curvature equal those of the cost for a linear residual."""
    covariance, precision = correlated(6)
    matrix, point = normal(6, 9), np.arange(9.0)

    @jax.jit
    def model(point):
        cost, step = ridge_model(matrix @ point - 1, jnp.asarray(matrix), point, covariance, precision)
        return cost, step(0.7)

    cost, (direction, slope, curvature) = model(point)
    off = matrix @ point - 1
    assert float(cost) == pytest.approx((off @ precision @ off + point @ point) / 2, rel=1e-12)
    for scale in (0.3, 1.0):
        expected = cost + scale * slope + scale**2 * curvature / 2
        assert float(model(point + scale * np.asarray(direction))[0]) == pytest.approx(float(expected), rel=1e-10)


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_same_minimum_as_scipy(damping):
    matrix, start = normal(6, 9), np.full(9, 2.0)
    found = minimise(Descent(rtol=1e-14, damping=damping), start, matrix, expand=expand)

    def misfits(c):
        return np.concatenate([np.arctan(matrix @ c) + 0.3 * np.sin(c[:6]) - 0.8, c])

    expected = least_squares(misfits, start, method="lm", xtol=1e-12, ftol=1e-12)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, expected.x, atol=1e-6)
    costs = np.asarray(found.state.history)[: int(found.state.num_accepted)]
    assert (np.diff(costs) < 0).all()


def test_a_linear_problem_takes_one_gauss_newton_step():
    matrix, noise, data = normal(4, 12), correlated(4), np.arange(4.0)

    def linear(c, data):
        return ridge_model(matrix @ c - data, jnp.asarray(matrix), c, *noise)

    solution = optx.least_squares(
        lambda c, y: (matrix @ c - y, c), Descent(), jnp.zeros(12), data, options={"expand": linear}
    )
    assert int(solution.state.num_accepted) == 2
    expected = compiled_step(matrix, -data, np.zeros(12), *noise, 1.0)
    np.testing.assert_allclose(solution.value, expected, rtol=1e-9)


def test_steps_below_the_rounding_of_the_cost_are_accepted():
    """Close to the minimum the cost changes by rounding only, while the model still decreases."""

    def rounded(c, _):
        away = c - 1.0
        cost = 1.0 + 0.5 * away @ away + 3e-15 * np.cos(1e9 * away).sum()

        def step(damping):
            direction = -0.9 * away  # of a model with an error of a tenth
            return direction, away @ direction, direction @ direction / 0.9

        return cost, step

    point, state = Descent(rtol=1e-24).at_once(rounded, 1.0 + np.linspace(0.1, 0.3, 5), None, 100)
    assert state.converged
    np.testing.assert_allclose(point, 1.0, rtol=0, atol=1e-11)


def test_a_start_with_invalid_cost_is_reported():
    solution = minimise(Descent(rtol=1e-14), np.full(9, np.nan), normal(6, 9), expand=expand)
    assert solution.result != optx.RESULTS.successful


def test_batches_equal_loops():
    matrices, solver = normal(3, 6, 9), Descent(rtol=1e-14)

    def run(matrix):
        return minimise(solver, jnp.zeros(9), matrix, expand=expand).value

    each = [run(matrix) for matrix in matrices]
    np.testing.assert_allclose(jax.vmap(run)(matrices), each, atol=1e-10)


def test_the_expansion_is_required():
    with pytest.raises(ValueError, match="expand"):
        minimise(Descent(), np.zeros(9), normal(6, 9))
