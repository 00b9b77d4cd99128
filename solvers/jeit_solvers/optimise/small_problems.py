"""Many small minimisations at once: functions of a few unknowns, damped Newton steps between bounds.

The batch is the last axis of every array, so that each operation runs along it; with two to six unknowns the linear
systems are solved by formulas written out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jeit_solvers.engines import complex_slope, host, namespace, set_at, slopes, while_loop

# Signature of a function that returns at x (n, F), with data whose last axis is F, its value (F,), gradient (n, F), and
# a positive definite model of its Hessian (n, n, F), the Gauss-Newton or Fisher matrix for instance.
Expansion = Callable[[Array, Any], tuple[Array, Array, Array]]

_MOST_DAMPING = 1e12
# Smallest number of functions that is worth gathering.
_LEAST_PART = 32
# Steps that the whole batch takes before what is left of it is gathered.
_WHOLE_STEPS = 8
# Between points whose slopes make a Hessian.
_APART = 1e-6


class Minimum(eqx.Module):
    """Result of the batch: `x` (n, F), `value` (F,), `converged` (F,), and the `steps` that the slowest took."""

    x: Float[Array, "n F"]
    value: Float[Array, " F"]
    converged: Bool[Array, " F"]
    steps: Int[Array, ""]


def solve_small(matrix: Float[Array, "n n F"], right: Float[Array, "n F"]) -> Float[Array, "n F"]:
    """Solve F symmetric positive definite systems of n unknowns by Cholesky's method, written out."""
    number, lower = matrix.shape[0], _cholesky(matrix)
    forward: list[Array] = []
    for i in range(number):
        rest = right[i] - sum(lower[i, k] * forward[k] for k in range(i))
        forward.append(rest / lower[i, i])
    solution: dict[int, Array] = {}
    for i in reversed(range(number)):
        rest = forward[i] - sum(lower[k, i] * solution[k] for k in range(i + 1, number))
        solution[i] = rest / lower[i, i]
    return namespace(matrix, right).stack([solution[i] for i in range(number)])


def gradient_small(value: Callable[[Array], Array], x: Float[Array, "n F"]) -> Float[Array, "n F"]:
    """The gradients at x of F functions, each of its own column: `value` (n, F) -> (F,), analytic."""
    if isinstance(x, np.ndarray):
        return host.stack(slopes(value, x)[1])
    return jax.grad(lambda at: jnp.sum(value(at)))(x)


def hessian_small(value: Callable[[Array], Array], x: Float[Array, "n F"]) -> Float[Array, "n n F"]:
    """The Hessians at x of F functions, each of its own column: `value` (n, F) -> (F,), analytic.

    In NumPy central differences of complex steps: good to some eight digits, for steps that need no more."""
    if isinstance(x, np.ndarray):
        apart = _APART * np.eye(len(x))[:, :, None]

        def second(k: int, m: int) -> Any:
            ahead, behind = (complex_slope(value, at, m) for at in (x + apart[k], x - apart[k]))
            return (ahead - behind) / (2 * _APART)

        return symmetric_small([[second(k, m) for m in range(k + 1)] for k in range(len(x))])
    directions = jnp.eye(len(x))[:, :, None] * jnp.ones_like(x)
    return jnp.stack([jax.jvp(partial(gradient_small, value), (x,), (direction,))[1] for direction in directions])


def definite_small(matrix: Float[Array, "n n F"]) -> Bool[Array, " F"]:
    """Whether each of F symmetric matrices is positive definite."""
    lower, xp = _cholesky(matrix), namespace(matrix)
    diagonal = xp.stack([lower[i, i] for i in range(len(matrix))])
    return xp.all(xp.isfinite(diagonal) & (diagonal > 0), axis=0)


def _cholesky(matrix: Float[Array, "n n F"]) -> dict[tuple[int, int], Array]:
    lower: dict[tuple[int, int], Array] = {}
    for j in range(matrix.shape[0]):
        for i in range(j, matrix.shape[0]):
            rest = matrix[i, j] - sum(lower[i, k] * lower[j, k] for k in range(j))
            lower[i, j] = namespace(matrix).sqrt(rest) if i == j else rest / lower[j, j]
    return lower


def symmetric_small(rows: Sequence[Sequence[Array]]) -> Float[Array, "n n F"]:
    """The symmetric matrices of which `rows` are the lower triangles, entries (F,)."""
    number, xp = len(rows), namespace(rows)
    return xp.stack([xp.stack([rows[max(i, j)][min(i, j)] for j in range(number)]) for i in range(number)])


def inverse_small(matrix: Float[Array, "n n F"]) -> Float[Array, "n n F"]:
    """The inverses of F symmetric positive definite matrices."""
    xp = namespace(matrix)
    identity = xp.eye(len(matrix))[:, :, None] * xp.ones_like(matrix[0])
    return xp.stack([solve_small(matrix, column) for column in identity])


class _State(eqx.Module):
    """State of each function of a batch."""

    x: Array
    value: Array
    gradient: Array
    matrix: Array
    damping: Array
    taken: Array
    done: Array
    converged: Array


class _Limits(NamedTuple):
    """Limits of the steps."""

    lower: Array
    upper: Array
    largest_step: Array
    max_steps: int
    tolerance: float


def minimise_small(
    expand: Expansion,
    start: Float[Array, "n F"],
    data: Any = None,
    *,
    finish: Expansion | None = None,
    lower: Float[Array, "n 1"],
    upper: Float[Array, "n 1"],
    largest_step: Float[Array, "n 1"],
    max_steps: int = 30,
    tolerance: float = 1e-10,
    skip: Bool[Array, " F"] | None = None,
) -> Minimum:
    """Minimise F functions of n unknowns between bounds by projected, damped Newton steps (Bertsekas 1982).

    `expand(x, data)`: see `Expansion`; `data`: arrays whose last axis is F. An unknown at its bound whose gradient
    pushes outwards is held; the others step. Damping as in Levenberg and Marquardt, by the diagonal. Converged: the
    next step promises to lower the value by less than `tolerance` · (1 + |value|). Functions that are not finite at
    their start stay there, not converged, their value infinite; so do those to `skip`.

    All take eight steps together; those that need more, mostly few, are then gathered and go on, with the expansion
    `finish` if there is one: a dearer one with the exact Hessian, say. A compiled program, whose arrays cannot shrink,
    gathers a quarter of the batch at a time.
    """
    limits = _Limits(lower, upper, largest_step, max_steps, tolerance)
    xp = namespace(start, data, lower, upper)
    first = xp.clip(start, lower, upper)
    number = first.shape[1]
    nothing = xp.zeros(number, bool)
    state = _State(
        x=first,
        value=xp.full(number, xp.inf),
        gradient=xp.zeros_like(first),
        matrix=xp.eye(len(first))[:, :, None] * xp.ones_like(first),
        damping=xp.full(number, 1e-2),
        taken=xp.zeros(number, int),
        done=nothing if skip is None else skip,
        converged=nothing,
    )
    part = number if xp is np else number // 4
    if part < _LEAST_PART:
        state = _advance(state, data, max_steps + 1, finish or expand, limits)
    else:
        if skip is None:
            state = _advance(state, data, _WHOLE_STEPS + 1, expand, limits)

        def go_on_with_some(state: _State) -> _State:
            index = _first_true(~state.done, part)
            gathered, mine = jax.tree.map(lambda array: xp.take(array, index, axis=-1, mode="clip"), (state, data))
            gathered = replace(gathered, done=gathered.done | (index == number))
            ended = _advance(gathered, mine, max_steps + 1, finish or expand, limits)
            return jax.tree.map(lambda all, some: set_at(all, (..., index), some), state, ended)

        state = while_loop(lambda state: ~xp.all(state.done), go_on_with_some, state)
    return Minimum(state.x, state.value, state.converged, xp.max(state.taken, initial=0))


def _first_true(which: Bool[Array, " F"], most: int) -> Int[Array, " i"]:
    """Indices of the first that are true: so many or fewer in NumPy; else so many, F where there are no more."""
    if isinstance(which, np.ndarray):
        return host.flatnonzero(which)[:most]
    return jnp.nonzero(which, size=most, fill_value=which.size)[0]


def _step_from(state: _State, limits: _Limits) -> tuple[Array, Array]:
    """End point of the next step, and the predicted decrease of the value, to first order."""
    x, gradient, matrix, xp = state.x, state.gradient, state.matrix, namespace(state)
    held = ((x <= limits.lower) & (gradient > 0)) | ((x >= limits.upper) & (gradient < 0))
    diagonal = xp.eye(x.shape[0], dtype=bool)[:, :, None]
    damped = matrix + diagonal * (state.damping * matrix + 1e-300)
    damped = xp.where(held[:, None] | held[None], xp.where(diagonal, 1.0, 0.0), damped)
    step = -solve_small(damped, xp.where(held, 0.0, gradient))
    step = xp.where(xp.isfinite(step), step, 0.0)
    step = step / xp.maximum(1.0, xp.max(xp.abs(step) / limits.largest_step, axis=0))
    new = xp.clip(x + step, limits.lower, limits.upper)
    return new, -xp.sum((new - x) * gradient, axis=0)


def _advance(state: _State, data, steps: int, expand: Expansion, limits: _Limits) -> _State:
    """Take this many steps of all functions, or fewer if all are done."""
    xp = namespace(state, data)

    def body(loop):
        count, state = loop
        # The first turn only looks at the start: no step leads away from there yet.
        fresh = xp.isinf(state.value)
        trial, promised = _step_from(state, limits)
        value, gradient, matrix = expand(trial, data)
        better = (value <= state.value) & ~state.done
        # Cut off at a bound, a step may lead uphill: then a more damped one, closer to the gradient, is tried.
        settled = (promised >= 0) & (promised <= limits.tolerance * (1 + xp.abs(state.value))) & ~fresh
        damping = xp.where(better, xp.maximum(state.damping / 10, 1e-12), 8 * xp.maximum(state.damping, 1e-4))
        taken = state.taken + ~(state.done | fresh)
        # A step too small to distinguish better from worse ends the search as well.
        converged = state.converged | (~state.done & (settled | (damping > _MOST_DAMPING)))
        broken = fresh & ~xp.isfinite(value)
        return count + 1, _State(
            x=xp.where(better, trial, state.x),
            value=xp.where(better, value, state.value),
            gradient=xp.where(better, gradient, state.gradient),
            matrix=xp.where(better, matrix, state.matrix),
            damping=damping,
            taken=taken,
            done=state.done | converged | broken | (taken >= limits.max_steps),
            converged=converged,
        )

    def go_on(loop):
        return (loop[0] < steps) & ~xp.all(loop[1].done)

    return while_loop(go_on, body, (xp.zeros((), int), state))[1]
