"""Gradients of functions of several named arrays against finite differences, for tests of images."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jeit.inverse.nonlinear.problem import as_solution
from jeit.inverse.nonlinear.solvers import AbstractSolver, Solution
from jeit_solvers import Status


class Known(AbstractSolver):
    """A solver that returns a given solution, and accepts bounds if `between` is true.

    It provides the derivatives of a reconstruction without the iteration, which takes seconds to compile.
    """

    name = "known"
    coefficients: Any
    between: bool = eqx.field(static=True, default=False)

    @property
    def keeps_bounds(self):
        return self.between

    def minimise(self, inversion, start, box):
        found = as_solution(self.coefficients, inversion, box)
        costs = jnp.stack([inversion.cost(start), inversion.cost(found)])
        return Solution(found, 0, costs, Status.CONVERGED.number, "")


def assert_gradient(function, theta, size, *, equal=1e-8, compiled=False):
    """Check reverse mode against differences of the uncompiled or `compiled` function, and its value.

    The value must equal the uncompiled result to the relative tolerance `equal`; None if there is no such result.
    """
    theta = {name: np.asarray(value, float) for name, value in theta.items()}
    program = jax.jit(jax.value_and_grad(function))
    value, gradient = program(theta)
    if equal is not None:
        np.testing.assert_allclose(value, function(theta), rtol=equal)
    assert_slopes((lambda theta: program(theta)[0]) if compiled else function, theta, gradient, size)


def assert_gradient_of_minimum(image, theta, size, solver, *, between=False):
    """Check a number that `image(theta, solver)` returns beside a reconstruction, without compiling the solver's
    iteration; `between` bounds, if it has any."""
    theta = {name: np.asarray(value, float) for name, value in theta.items()}
    found, number = image(theta, solver)
    program = jax.jit(jax.value_and_grad(lambda theta, ended: image(theta, Known(ended, between))[1]))
    value, gradient = program(theta, found.coefficients)
    np.testing.assert_allclose(value, number, rtol=1e-8)
    assert_slopes(lambda theta: image(theta, solver)[1], theta, gradient, size)


def assert_slopes(answer, theta, gradient, size):
    """Check against fourth-order central differences; one of six step sizes must agree to 1e-5.

    Each number is changed in proportion to its own size, because the terms of other directional derivatives may almost
    cancel. `size` replaces the size of small arrays; without it, the array itself is used.
    """
    random = np.random.default_rng(11)
    for name, at in theta.items():
        direction = np.abs(random.normal(size=at.shape) * size.get(name, at)) * np.sign(gradient[name])
        found, errors = float(np.vdot(gradient[name], direction)), []
        for step in (1e-3, 1e-2, 3e-3, 3e-4, 1e-4, 1e-5):

            def moved(times, name=name, along=step * direction):
                return float(answer(theta | {name: theta[name] + times * along}))

            near, far = moved(1) - moved(-1), moved(2) - moved(-2)
            errors.append(abs(found / ((8 * near - far) / (12 * step)) - 1))
            if errors[-1] <= 1e-5:
                break
        assert min(errors) <= 1e-5, (name, found, errors)
