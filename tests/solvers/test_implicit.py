"""Derivatives of a minimum against differences of minima computed to rounding in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit_solvers import as_minimum

MATRIX = np.random.default_rng(0).normal(size=(6, 4))
PROBLEM = {"y": 0.5 * np.random.default_rng(1).normal(size=6), "weight": np.array(0.7)}


def cost(x, problem):
    residual = jnp.tanh(MATRIX @ x) - problem["y"]
    return 0.5 * residual @ residual + 0.5 * problem["weight"] * x @ x + 0.1 * jnp.sum(x**4)


def steps(problem, number):
    """This number of Newton steps from zero, in NumPy."""
    x = np.zeros(4)
    for _ in range(number):
        curve = np.tanh(MATRIX @ x)
        slope = 1 - curve**2
        residual = curve - problem["y"]
        gradient = MATRIX.T @ (slope * residual) + problem["weight"] * x + 0.4 * x**3
        inner = slope**2 - 2 * curve * slope * residual
        hessian = (MATRIX.T * inner) @ MATRIX + np.diag(problem["weight"] + 1.2 * x**2)
        x = x - np.linalg.solve(hessian, gradient)
    return x


def precondition(x, problem):
    return lambda vector: vector / (problem["weight"] + 4)


NEAR = steps(PROBLEM, 2)


def minimum(problem):
    """A point near the minimum, whose dependence on the problem is arbitrary and must not enter the derivatives."""
    return as_minimum(NEAR * (1 + 0.1 * (problem["weight"] - 0.7)), problem, jax.grad(cost), precondition)


def differences(function, step):
    """First and second derivative at zero, by fourth-order central differences."""
    far_behind, behind, here, ahead, far_ahead = (function(by * step) for by in (-2, -1, 0, 1, 2))
    first = (8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * step)
    return first, (16 * (ahead + behind) - (far_ahead + far_behind) - 30 * here) / (12 * step**2)


@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_first_derivatives(mode):
    found = jax.jit(mode(minimum))(PROBLEM)
    for k, unit in enumerate(np.eye(6)):
        expected = differences(lambda by, way=unit: steps(PROBLEM | {"y": PROBLEM["y"] + by * way}, 12), 1e-3)[0]
        np.testing.assert_allclose(found["y"][:, k], expected, rtol=0, atol=1e-8)
    expected = differences(lambda by: steps(PROBLEM | {"weight": 0.7 + by}, 12), 1e-3)[0]
    np.testing.assert_allclose(found["weight"], expected, rtol=0, atol=1e-8)


def test_the_point_itself_is_returned_unchanged():
    np.testing.assert_array_equal(minimum(PROBLEM), NEAR)


def test_second_derivatives_and_batches():
    weights = np.array([0.7, 1.0])
    found = jax.jit(jax.vmap(jax.grad(jax.grad(lambda weight: minimum(PROBLEM | {"weight": weight}).sum()))))(weights)
    expected = [
        differences(lambda by, at=at: steps(PROBLEM | {"weight": at + by}, 15).sum(), 1e-2)[1] for at in weights
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
