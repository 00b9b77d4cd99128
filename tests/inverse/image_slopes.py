"""Gradients of functions of several arrays by name against finite differences: shared by tests of images."""

import jax
import numpy as np


def assert_gradient(function, theta, size, *, equal=1e-8, compiled=False):
    """Reverse mode against differences of what is answered at once, or `compiled`; and the value, which is to be
    `equal`."""
    theta = {name: np.asarray(value, float) for name, value in theta.items()}
    value, gradient = jax.jit(jax.value_and_grad(function))(theta)
    np.testing.assert_allclose(value, function(theta), rtol=equal)
    assert_slopes(jax.jit(function) if compiled else function, theta, gradient, size)


def assert_slopes(answer, theta, gradient, size):
    """Against central differences of fourth order. Large steps bend and small ones are rounded: one of six has to agree
    to 1e-5.

    Steps go up wherever they go, each number by a share of its own: along others the parts of a slope may all but
    cancel, and differences are of rounding. `size` has what is small beside each number; without one it is itself."""
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
