"""Batches of small systems against NumPy, and of small minimisations with bounds against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from jeit_solvers import gradient_small, hessian_small, inverse_small, minimise_small, solve_small


def definite(number, batch, seed=0, spread=3.0):
    """Symmetric positive definite matrices (batch, n, n), with condition numbers up to some thousand."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(batch, number, number)))[0]
    return (turn * np.exp(spread * rng.random((batch, 1, number)) * np.log(10) / 2)) @ turn.transpose(0, 2, 1)


@jax.jit
def solved_and_inverted(matrices, right):
    return solve_small(matrices, right), inverse_small(matrices)


@pytest.mark.parametrize("number", [1, 2, 3, 4, pytest.param(5, marks=pytest.mark.slow), 6])
def test_systems_are_solved(number):
    matrices = definite(number, 20)
    right = np.random.default_rng(1).normal(size=(20, number))
    expected = np.linalg.solve(matrices, right[..., None])[..., 0]
    # Rounding times the condition number.
    solved, inverse = solved_and_inverted(matrices.transpose(1, 2, 0), right.T)
    np.testing.assert_allclose(solved.T, expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(np.moveaxis(np.asarray(inverse), -1, 0), np.linalg.inv(matrices), rtol=1e-9, atol=1e-10)


def test_systems_do_not_depend_on_scaling():
    """Unknowns in units as different as metres and logarithms: the matrix is scaled by D on both sides."""
    matrix, right = definite(4, 1)[0], np.arange(1.0, 5.0)
    scale = np.array([1e-9, 1.0, 1e6, 1e12])
    solved, _ = solved_and_inverted((matrix * np.outer(scale, scale))[:, :, None], (right * scale)[:, None])
    np.testing.assert_allclose(np.asarray(solved)[:, 0] * scale, np.linalg.solve(matrix, right), rtol=1e-10)


def test_only_the_singular_system_of_a_batch_is_nan():
    matrices = np.array(definite(3, 4))
    matrices[2] = -matrices[2]
    solved = np.asarray(solved_and_inverted(matrices.transpose(1, 2, 0), np.ones((3, 4)))[0])
    assert np.isnan(solved[:, 2]).all()
    np.testing.assert_allclose(solved[:, [0, 1, 3]].T, np.linalg.solve(matrices[[0, 1, 3]], np.ones((3, 3, 1)))[..., 0])


def test_systems_are_differentiable():
    """d(A⁻¹ b) = -A⁻¹ dA A⁻¹ b + A⁻¹ db."""
    matrix, change = definite(3, 2)
    right, shift = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -1.0])
    solved = np.linalg.solve(matrix, right)
    expected = np.linalg.solve(matrix, shift - change @ solved)

    def solve(matrix, right):
        return solve_small(matrix[:, :, None], right[:, None])[:, 0]

    slope = jax.jit(lambda at, way: jax.jvp(solve, at, way)[1])((matrix, right), (change, shift))
    np.testing.assert_allclose(slope, expected, rtol=1e-10)


# A quarter of the batch is enough to gather those that need more steps.
NUMBER, BATCH = 3, 200
LOW, HIGH = np.array([-1.0, -0.5, -2.0]), np.array([1.0, 0.8, 0.3])


@pytest.fixture(scope="module")
def problems():
    """Σ log cosh(A (x - c)) + ½ ridge: not quadratic, convex, with minima inside the box, on sides, and in corners."""
    rng = np.random.default_rng(2)
    # The batch is the last axis of the arguments.
    return rng.normal(size=(5, NUMBER, BATCH)), 1.5 * rng.normal(size=(NUMBER, BATCH))


def value_of(x, matrix, centre):
    off = matrix @ (x - centre)
    return np.sum(np.logaddexp(off, -off)) + 0.05 * np.sum((x - centre) ** 2)


def expand(x, data):
    matrix, centre = data
    off = jnp.einsum("ijf,jf->if", matrix, x - centre)
    value = jnp.sum(jnp.logaddexp(off, -off), axis=0) + 0.05 * jnp.sum((x - centre) ** 2, axis=0)
    gradient = jnp.einsum("ijf,if->jf", matrix, jnp.tanh(off)) + 0.1 * (x - centre)
    curvature = jnp.einsum("ijf,if,ikf->jkf", matrix, 1 - jnp.tanh(off) ** 2, matrix)
    return value, gradient, curvature + 0.1 * jnp.eye(NUMBER)[:, :, None]


expanded = jax.jit(expand)


@jax.jit
def descended(start, problems, skip, max_steps):
    return minimise_small(
        expand,
        start,
        problems,
        lower=jnp.asarray(LOW)[:, None],
        upper=jnp.asarray(HIGH)[:, None],
        largest_step=jnp.full((NUMBER, 1), 0.5),
        max_steps=max_steps,
        tolerance=1e-14,
        skip=skip,
    )


def descend(start, problems, skip=None, max_steps=100):
    """By one program for any skipped problems and any number of steps."""
    return descended(start, problems, np.zeros(start.shape[1], bool) if skip is None else skip, max_steps)


@pytest.fixture(scope="module")
def found(problems):
    start = np.random.default_rng(3).uniform(LOW[:, None], HIGH[:, None], (NUMBER, BATCH))
    return start, descend(jnp.asarray(start), problems)


def test_same_minimum_as_scipy(problems, found):
    """Inside the box, on its sides and in its corners: the problems include all of these."""
    x = np.asarray(found[1].x).T
    assert found[1].converged.all()
    for k in range(30):
        mine, matrix, centre, value = x[k], problems[0][..., k], problems[1][:, k], found[1].value[k]
        theirs = minimize(
            value_of,
            np.zeros(NUMBER),
            args=(matrix, centre),
            bounds=list(zip(LOW, HIGH, strict=True)),
            method="L-BFGS-B",
            options={"ftol": 1e-15, "gtol": 1e-9, "maxiter": 1000},
        )
        # SciPy differentiates numerically, so that its minimum is accurate to about 1e-5.
        np.testing.assert_allclose(mine, theirs.x, atol=3e-5)
        assert value <= theirs.fun + 1e-10
        assert float(value) == pytest.approx(value_of(mine, matrix, centre), rel=1e-12)
    held = ((x <= LOW + 1e-12) | (x >= HIGH - 1e-12)).sum(axis=1)
    assert set(held) == {0, 1, 2, 3}


def test_first_order_conditions(problems, found):
    """The gradient is zero where x is free, and points out of the box where x is at a bound."""
    x = np.asarray(found[1].x)
    gradient = np.asarray(expanded(x, problems)[1])
    free = (x > LOW[:, None]) & (x < HIGH[:, None])
    assert np.abs(gradient[free]).max() < 1e-5
    assert (gradient[x == LOW[:, None]] >= 0).all()
    assert (gradient[x == HIGH[:, None]] <= 0).all()


def test_the_start_does_not_matter(problems, found):
    far = np.full((NUMBER, BATCH), 50.0)  # outside of the bounds
    np.testing.assert_allclose(descend(far, problems).x, found[1].x, atol=1e-6)


def test_batches_equal_loops(problems, found):
    start, x = found[0], np.asarray(found[1].x)
    for k in range(0, BATCH, 40):
        alone = descend(start[:, k : k + 1], tuple(part[..., k : k + 1] for part in problems))
        np.testing.assert_allclose(np.asarray(alone.x)[:, 0], x[:, k], atol=1e-10)
        assert int(alone.steps) <= int(found[1].steps)
    order = np.random.default_rng(4).permutation(BATCH)
    shuffled = descend(start[:, order], tuple(part[..., order] for part in problems))
    np.testing.assert_allclose(shuffled.x, x[:, order], atol=1e-12)


def test_a_start_that_is_not_finite_is_kept_and_reported(problems, found):
    """It does not affect the others."""
    matrix = problems[0].copy()
    matrix[..., 7] = np.nan
    start = found[0]
    result = descend(start, (matrix, problems[1]))
    assert not np.asarray(result.converged)[7]
    np.testing.assert_array_equal(np.asarray(result.x)[:, 7], start[:, 7])
    others = np.arange(BATCH) != 7
    assert np.asarray(result.converged)[others].all()
    np.testing.assert_allclose(np.asarray(result.x)[:, others], np.asarray(found[1].x)[:, others], atol=1e-12)


def test_skipped_problems_keep_their_start_and_are_not_converged(problems, found):
    skip = np.random.default_rng(5).random(BATCH) < 0.6
    start = found[0]
    result = descend(start, problems, skip)
    np.testing.assert_array_equal(result.converged, ~skip)
    np.testing.assert_array_equal(np.asarray(result.x)[:, skip], start[:, skip])
    np.testing.assert_allclose(np.asarray(result.x)[:, ~skip], np.asarray(found[1].x)[:, ~skip], atol=1e-10)
    nothing = descend(start, problems, np.ones(BATCH, bool))
    np.testing.assert_array_equal(nothing.x, start)
    assert int(nothing.steps) == 0


def test_the_maximum_of_steps_is_not_exceeded(problems, found):
    """Nor for those gathered after the first steps: some are then reported as not converged."""
    some = descend(found[0], problems, max_steps=8)
    assert int(some.steps) == 8
    assert 0 < int(some.converged.sum()) < BATCH
    done = np.asarray(some.converged)
    np.testing.assert_allclose(np.asarray(some.x)[:, done], np.asarray(found[1].x)[:, done], atol=1e-6)


def test_a_step_cut_off_at_a_bound_is_still_a_descent():
    """The second unknown's bound cuts off the Newton step so that the remainder points uphill, away from the
    minimum."""
    matrix, target = np.array([[8.55, -2.94], [-2.94, 1.14]]), np.array([[0.5], [2.3]])

    def expand(x, _):
        off = x - target
        return 0.5 * np.sum(off * (matrix @ off), axis=0), matrix @ off, matrix[:, :, None]

    limit = np.ones((2, 1))
    result = minimise_small(expand, np.zeros((2, 1)), lower=-limit, upper=limit, largest_step=np.inf * limit)
    # At y = 1 the minimum is where the first slope is zero: 8.55 (x - 0.5) = 2.94 (1 - 2.3).
    np.testing.assert_allclose(result.x[:, 0], [0.5 - 2.94 * 1.3 / 8.55, 1.0], atol=1e-6)
    assert result.converged.all()


def test_a_quadratic_takes_few_steps():
    """With Newton steps, the initial damping of a thousandth leaves a thousandth of the error in each step."""
    matrix, target = np.asarray(definite(2, 1)[0]), np.array([0.3, -0.2])

    def expand(x, _):
        off = x - target[:, None]
        return 0.5 * np.einsum("if,ij,jf->f", off, matrix, off), matrix @ off, matrix[:, :, None]

    limit = np.full((2, 1), np.inf)
    result = minimise_small(expand, np.zeros((2, 1)), lower=-limit, upper=limit, largest_step=limit)
    assert result.converged.all()
    assert int(result.steps) <= 6
    np.testing.assert_allclose(result.x[:, 0], target, atol=1e-7)


def test_steps_do_not_exceed_the_given_length():
    """Curvature suggests a step of a thousand; each step is at most 0.25, and four steps are at most one."""

    def expand(x, _):
        slope = np.full_like(x, -1.0)
        return -x[0], slope, np.full((1, 1, x.shape[1]), 1e-3)

    limit = np.full((1, 1), np.inf)
    result = minimise_small(
        expand, np.zeros((1, 3)), lower=-limit, upper=limit, largest_step=np.full((1, 1), 0.25), max_steps=4
    )
    np.testing.assert_allclose(result.x, 1.0, rtol=1e-12)
    assert not result.converged.any()
    assert int(result.steps) == 4


def test_the_result_is_never_higher_than_the_start():
    """In Rosenbrock's curved valley, where full steps would go uphill; compared with SciPy's solution, (1, 1)."""

    def expand(x, _):
        off = np.stack([1 - x[0], 10 * (x[1] - x[0] ** 2)])
        one = np.ones_like(x[0])
        rows = np.stack([np.stack([-one, 0 * one]), np.stack([-20 * x[0], 10 * one])])
        return (
            0.5 * np.sum(off**2, axis=0),
            np.einsum("ijf,if->jf", rows, off),
            np.einsum("ijf,ikf->jkf", rows, rows),
        )

    start = np.array([[-1.2, 0.0, 2.0], [1.0, 3.0, -2.0]])
    limit = np.full((2, 1), np.inf)
    costs = []
    for steps in (1, 2, 4, 8, 100):
        result = minimise_small(
            expand, start, lower=-limit, upper=limit, largest_step=limit, max_steps=steps, tolerance=1e-16
        )
        costs.append(np.asarray(result.value))
    assert (np.diff(costs, axis=0) <= 0).all()
    assert result.converged.all()
    np.testing.assert_allclose(result.x, 1.0, atol=1e-6)


def test_numpy_and_compiled_code_agree(problems, found):
    """They take the same steps, although NumPy gathers all remaining problems at once."""
    start = found[0]
    limits = [bound[:, None] for bound in (LOW, HIGH)]
    options = {"lower": limits[0], "upper": limits[1], "largest_step": np.full((NUMBER, 1), 0.5), "tolerance": 1e-14}

    def in_numpy(x, data):
        return tuple(np.asarray(part) for part in expanded(x, data))

    at_once = minimise_small(in_numpy, start, problems, max_steps=100, **options)
    np.testing.assert_allclose(at_once.x, found[1].x, atol=1e-10)
    assert at_once.converged.all()


def test_derivatives_in_numpy(problems):
    """Gradients to rounding, Hessians to eight digits."""
    matrix, centre = problems

    def value(x):
        off = (matrix * (x - centre)[None]).sum(axis=1)
        return (off**4).sum(axis=0) + (off**2).sum(axis=0)

    x = np.random.default_rng(6).uniform(-1, 1, (NUMBER, BATCH))
    gradient, hessian = jax.jit(lambda x: (gradient_small(value, x), hessian_small(value, x)))(x)
    np.testing.assert_allclose(gradient_small(value, x), gradient, rtol=1e-12, atol=1e-12 * np.abs(gradient).max())
    np.testing.assert_allclose(hessian_small(value, x), hessian, rtol=1e-7, atol=1e-8 * np.abs(hessian).max())
