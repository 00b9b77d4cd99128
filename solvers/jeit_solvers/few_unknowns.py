"""Many small minimisations at once: functions of a few unknowns, damped Newton steps between bounds.

The batch is the last axis of every array, so that each operation runs along it; with two to six unknowns the linear
systems are solved by formulas written out.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# What a function must give at x (n, F): its value (F,), gradient (n, F), and a positive definite model of its Hessian
# (n, n, F), the Gauss-Newton or Fisher matrix for instance.
Expansion = Callable[[Array], tuple[Array, Array, Array]]

_MOST_DAMPING = 1e12


class Minimum(eqx.Module):
    """Where the batch ended: `x` (n, F), `value` (F,), `converged` (F,), and the `steps` that the slowest took."""

    x: Float[Array, "n F"]
    value: Float[Array, " F"]
    converged: Bool[Array, " F"]
    steps: Int[Array, ""]


def solve_few(matrix: Float[Array, "n n F"], right: Float[Array, "n F"]) -> Float[Array, "n F"]:
    """Solve F symmetric positive definite systems of n unknowns by Cholesky's method, written out."""
    number = matrix.shape[0]
    lower: dict[tuple[int, int], Array] = {}
    for j in range(number):
        for i in range(j, number):
            rest = matrix[i, j] - sum((lower[i, k] * lower[j, k] for k in range(j)), jnp.zeros(()))
            lower[i, j] = jnp.sqrt(rest) if i == j else rest / lower[j, j]
    forward: list[Array] = []
    for i in range(number):
        rest = right[i] - sum((lower[i, k] * forward[k] for k in range(i)), jnp.zeros(()))
        forward.append(rest / lower[i, i])
    solution: dict[int, Array] = {}
    for i in reversed(range(number)):
        rest = forward[i] - sum((lower[k, i] * solution[k] for k in range(i + 1, number)), jnp.zeros(()))
        solution[i] = rest / lower[i, i]
    return jnp.stack([solution[i] for i in range(number)])


def inverse_few(matrix: Float[Array, "n n F"]) -> Float[Array, "n n F"]:
    """The inverses of F symmetric positive definite matrices."""
    identity = jnp.eye(len(matrix))[:, :, None] * jnp.ones_like(matrix[0])
    return jnp.stack([solve_few(matrix, column) for column in identity])


def minimise_few(
    expand: Expansion,
    start: Float[Array, "n F"],
    *,
    lower: Float[Array, "n #F"],
    upper: Float[Array, "n #F"],
    largest_step: Float[Array, "n #F"],
    max_steps: int = 30,
    tolerance: float = 1e-10,
) -> Minimum:
    """Minimise F functions of n unknowns between bounds by projected, damped Newton steps (Bertsekas 1982).

    An unknown at its bound whose gradient pushes outwards is held; the others step. Damping as in Levenberg and
    Marquardt, by the diagonal. Converged: the next step promises to lower the value by less than `tolerance` ·
    (1 + |value|). Functions that are not finite at their start stay there, not converged.
    """
    first = jnp.clip(start, lower, upper)

    def step_from(x, gradient, matrix, damping):
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        free = ~held
        pairs = free[:, None] & free[None]
        diagonal = jnp.eye(x.shape[0], dtype=bool)[:, :, None]
        damped = matrix + diagonal * (damping * matrix + 1e-300)
        damped = jnp.where(pairs, damped, jnp.where(diagonal, 1.0, 0.0))
        step = -solve_few(damped, jnp.where(free, gradient, 0.0))
        step = jnp.where(jnp.isfinite(step), step, 0.0)
        step = step / jnp.maximum(1.0, jnp.max(jnp.abs(step) / largest_step, axis=0))
        new = jnp.clip(x + step, lower, upper)
        promised = -jnp.sum((new - x) * gradient, axis=0)
        return new, promised

    def go_on(state):
        return (state[0] < max_steps) & ~jnp.all(state[-1])

    def body(state):
        number, x, value, gradient, matrix, damping, done = state
        trial, promised = step_from(x, gradient, matrix, damping)
        settled = promised <= tolerance * (1 + jnp.abs(value))
        new_value, new_gradient, new_matrix = expand(trial)
        better = (new_value <= value) & ~done
        x = jnp.where(better, trial, x)
        gradient = jnp.where(better, new_gradient, gradient)
        matrix = jnp.where(better, new_matrix, matrix)
        value = jnp.where(better, new_value, value)
        damping = jnp.where(better, jnp.maximum(damping / 10, 1e-12), 8 * jnp.maximum(damping, 1e-4))
        # A step too small to tell better from worse ends the search as well.
        done = done | settled | (damping > _MOST_DAMPING)
        return number + 1, x, value, gradient, matrix, damping, done

    value, gradient, matrix = expand(first)
    broken = ~jnp.isfinite(value)
    state = (jnp.zeros((), int), first, value, gradient, matrix, jnp.full(value.shape, 1e-3), broken)
    number, x, value, *_, done = jax.lax.while_loop(go_on, body, state)
    return Minimum(x, value, done & ~broken, number)
