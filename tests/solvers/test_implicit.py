"""Derivatives of a minimum against those of the steps that lead there, all of them differentiated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit_solvers import as_minimum

MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(6, 4)))
PROBLEM = {"y": 0.5 * jnp.asarray(np.random.default_rng(1).normal(size=6)), "weight": jnp.asarray(0.7)}


def cost(x, problem):
    residual = jnp.tanh(MATRIX @ x) - problem["y"]
    return 0.5 * residual @ residual + 0.5 * problem["weight"] * x @ x + 0.1 * jnp.sum(x**4)


def steps(problem, number):
    """So many of Newton's steps from zero."""

    def step(x, _):
        return x - jnp.linalg.solve(jax.hessian(cost)(x, problem), jax.grad(cost)(x, problem)), None

    return jax.lax.scan(step, jnp.zeros(4), None, length=number)[0]


def precondition(x, problem):
    return lambda vector: vector / (problem["weight"] + 4)


def minimum(problem):
    """From a point that is near, not there."""
    return as_minimum(steps(problem, 2), problem, jax.grad(cost), precondition)


@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_first_derivatives(mode):
    found, expected = jax.jit(mode(minimum))(PROBLEM), jax.jit(jax.jacfwd(lambda p: steps(p, 12)))(PROBLEM)
    for name in PROBLEM:
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-8)


def test_the_point_itself_is_as_it_was_found():
    np.testing.assert_array_equal(minimum(PROBLEM), steps(PROBLEM, 2))


def test_second_derivatives_and_batches():
    def value(weight, solve):
        return solve(PROBLEM | {"weight": weight}).sum()

    weights = jnp.asarray([0.7, 1.0])
    found = jax.jit(jax.vmap(jax.grad(jax.grad(lambda w: value(w, minimum)))))(weights)
    expected = jax.jit(jax.vmap(jax.grad(jax.grad(lambda w: value(w, lambda p: steps(p, 12))))))(weights)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
