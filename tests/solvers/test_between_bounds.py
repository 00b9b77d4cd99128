"""Minimisation with bounds against exact solutions, its status, and the one module that imports jaxopt."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit_solvers import Status, lbfgsb, projected_gradient, scipy_lbfgsb

ROOT = Path(__file__).resolve().parents[2]
AIM = np.array([-1.0, 0.3, 2.0])
LOWER, UPPER = np.zeros(3), np.ones(3)


def squares(x):
    """A function with its minimum at `AIM`; within bounds, at the nearest point."""
    return jnp.sum(np.array([1.0, 4.0, 9.0]) * (x - AIM) ** 2)


@pytest.mark.parametrize("solver", [lbfgsb, projected_gradient])
def test_the_nearest_point_in_a_box(solver):
    @jax.jit
    def run(start, max_steps):
        return solver(squares, start, LOWER, UPPER, max_steps=max_steps, tolerance=1e-8)

    found = run(0.5 * UPPER, max_steps=200)
    np.testing.assert_allclose(found.x, [0, 0.3, 1], atol=1e-7)
    assert bool(found.converged)
    assert not bool(run(0.5 * UPPER, max_steps=1).converged)


@pytest.mark.parametrize("solver", [lbfgsb, projected_gradient])
def test_the_objective_is_evaluated_between_the_bounds_only(solver):
    """The accelerated gradient method would pass this minimum near a bound with its momentum."""
    aim, curvature = np.array([0.01, 0.6]), np.array([[1.0, 0.9], [0.9, 1.0]])

    def defined_for_positive(x):
        distance = jnp.exp(jnp.log(x)) - aim
        return distance @ curvature @ distance

    @jax.jit
    def run(start):
        return solver(defined_for_positive, start, 1e-3, 1.0, max_steps=1000, tolerance=1e-6)

    found = run(np.ones(2))
    np.testing.assert_allclose(found.x, aim, atol=1e-4)
    assert bool(found.converged)


def test_scipy_solver_keeps_the_shape_and_reports_its_status():
    seen = []
    of_rows = jax.jit(jax.value_and_grad(lambda x: squares(x[0]) + squares(x[1])))
    start = np.full((2, 3), 0.5)
    found, value, status = scipy_lbfgsb(of_rows, start, 0.0, 1.0, tolerance=1e-12, callback=seen.append)
    np.testing.assert_allclose(found, [[0, 0.3, 1]] * 2, atol=1e-7)
    assert value == pytest.approx(2 * (1 + 9), rel=1e-12)
    assert status == Status.CONVERGED == "converged"
    assert {one.shape for one in seen} == {(2, 3)}
    valley = jax.jit(jax.value_and_grad(lambda x: 100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2))
    _, _, status = scipy_lbfgsb(valley, np.array([-1.2, 1.0]), -2.0, 2.0, tolerance=1e-12, max_steps=2)
    assert status == Status.STEP_LIMIT


def test_one_module_imports_jaxopt():
    """jaxopt is no longer maintained; with one importing module it can be replaced in one place."""
    found = set()
    for path in [*(ROOT / "jeit").rglob("*.py"), *(ROOT / "solvers").rglob("*.py")]:
        text = path.read_text("utf-8")
        for node in ast.walk(ast.parse(text)) if "jaxopt" in text else ():
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0] == "jaxopt" for name in names):
                found.add(path.relative_to(ROOT).as_posix())
    assert found == {"solvers/jeit_solvers/optimise/descent.py"}
