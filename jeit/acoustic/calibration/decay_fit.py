"""Decay models fitted to taps of unknown strength: the least-squares problems of a calibration.

Microphones are the first axis, taps the last. Each microphone alone, the taps' strengths given, is a problem of K
unknowns; all of them together with the strengths one of K M + T, in which the strengths are eliminated (a Schur
complement): what is left is no larger than the array. Both run through optimistix, with jeit_solvers' `Descent`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jeit.acoustic.decay import AbstractDecay
from jeit_solvers import Descent, minimise_small, scipy_lbfgsb, solve_definite, solve_small

_MOST_STEPS = 100
# In units of the weights, which are inverse variances: what is left once the data are met to rounding.
_SOLVER = Descent(rtol=1e-10, atol=1e-20, damping=1e-2, history=1)


class DecayProblem(eqx.Module):
    """Levels y (M, T) at squared distances r² (m²), with weights (0: not used), and the floors N (M,)."""

    level: Float[Array, "M T"]
    squared_distance: Float[Array, "M T"]
    weight: Float[Array, "M T"]
    floor: Float[Array, " M"]
    decay: type[AbstractDecay] = eqx.field(static=True)

    def expected(self, logarithms: Float[Array, "K M"], strength: Float[Array, " T"]):
        """log(e^s f + N), its slope in s or log f, and the slopes (K, M, T) of log f in the parameters."""

        def response(values):
            return self.decay.from_logarithms(values).log_response(self.squared_distance)

        log_response, push = jax.linearize(response, logarithms)
        basis = jnp.eye(len(logarithms))[:, :, None] * jnp.ones_like(logarithms)
        slopes = jnp.stack([push(direction) for direction in basis])
        received = jnp.exp(strength + log_response)
        total = received + self.floor[:, None]
        return jnp.log(total), received / total, slopes

    def residual(self, logarithms: Float[Array, "K M"], strength: Float[Array, " T"]) -> Float[Array, "M T"]:
        """y − m, and 0 for what has no weight."""
        mean = self.expected(logarithms, strength)[0]
        return jnp.where(self.weight > 0, self.level - mean, 0.0)


@eqx.filter_jit
def fit_strengths(problem: DecayProblem, logarithms: Float[Array, "K M"], start: Float[Array, " T"]):
    """The strengths of all taps, the microphones' models given, (T,)."""

    def expand(unknown, taps):
        level, squared_distance, weight = taps
        some = DecayProblem(level, squared_distance, weight, problem.floor, problem.decay)
        mean, share, _ = some.expected(logarithms, unknown[0])
        off = jnp.where(weight > 0, level - mean, 0.0)
        value = 0.5 * jnp.sum(weight * off**2, axis=0)
        gradient = -jnp.sum(weight * share * off, axis=0)
        curvature = jnp.sum(weight * share**2, axis=0)
        return value, gradient[None], jnp.maximum(curvature, 1e-30)[None, None]

    limit = jnp.full((1, 1), jnp.inf)
    return minimise_small(
        expand,
        start[None],
        (problem.level, problem.squared_distance, problem.weight),
        lower=-limit,
        upper=limit,
        largest_step=jnp.full((1, 1), 3.0),
        max_steps=40,
    ).x[0]


@eqx.filter_jit
def fit_each(problem: DecayProblem, start: Float[Array, "K M"], strength: Float[Array, " T"]) -> Float[Array, "K M"]:
    """Every microphone's parameters, the strengths given: Levenberg-Marquardt, `vmap` over microphones."""

    def fit(mine: DecayProblem, first):
        def expand(values, _):
            mean, share, slopes = mine.expected(values[:, None], strength)
            off = jnp.where(mine.weight > 0, mine.level - mean, 0.0)[0]
            jacobian = share[0] * slopes[:, 0]
            weighted = jacobian * mine.weight[0]
            matrix, gradient = weighted @ jacobian.T, -weighted @ off

            def step(damping):
                damped = matrix * (1 + damping * jnp.eye(len(values))) + 1e-300 * jnp.eye(len(values))
                direction = -solve_small(damped[:, :, None], gradient[:, None])[:, 0]
                return direction, gradient @ direction, direction @ matrix @ direction

            return 0.5 * jnp.sum(mine.weight[0] * off**2), step

        found = optx.least_squares(
            lambda values, _: values, _SOLVER, first, options={"expand": expand}, max_steps=_MOST_STEPS, throw=False
        )
        return found.value

    # One microphone each, still with its axis of length one.
    alone = jax.tree.map(lambda array: array[:, None], problem)
    return jax.vmap(fit, in_axes=(0, 1), out_axes=1)(alone, start)


@eqx.filter_jit
def fit_together(
    problem: DecayProblem, start: Float[Array, "K M"], strength: Float[Array, " T"], free: Bool[Array, "K M"]
) -> tuple[Float[Array, "K M"], Float[Array, " T"]]:
    """The parameters that are `free`, and the strengths of all taps, at once."""
    shape = start.shape

    def unpack(unknowns):
        return unknowns[: start.size].reshape(shape), unknowns[start.size :]

    def expand(unknowns, _):
        values, strengths = unpack(unknowns)
        cost, system = _normal_equations(problem, values, strengths, free)

        def step(damping):
            change, shift = _step(system, damping)
            slope = jnp.sum(system.gradient * change) + system.tap_gradient @ shift
            inner = jnp.einsum("km,lm,mkl->", change, change, system.matrix)
            across = 2 * jnp.einsum("km,kmt,t->", change, system.coupling, shift)
            return (
                jnp.concatenate([change.ravel(), shift]),
                slope,
                inner + across + jnp.sum(system.tap_matrix * shift**2),
            )

        return cost, step

    found = optx.least_squares(
        lambda values, _: values,
        _SOLVER,
        jnp.concatenate([start.ravel(), strength]),
        options={"expand": expand},
        max_steps=_MOST_STEPS,
        throw=False,
    )
    return unpack(found.value)


def fit_between(
    problem: DecayProblem, start: Float[Array, "K M"], strength: Float[Array, " T"], microphone: int, bounds
) -> tuple[Float[np.ndarray, " K"], float]:
    """The parameters of one microphone, (K,), between bounds on their logarithms, and their cost, by L-BFGS-B."""
    lower, upper = (jnp.asarray(bound) for bound in bounds)
    first = jnp.clip(start[:, microphone], lower, upper)
    mine = jax.tree.map(lambda array: array[microphone][None], problem)
    found, cost, _ = scipy_lbfgsb(
        lambda values: _cost_and_slope(values, mine, strength), first, lower, upper, tolerance=1e-12
    )
    return found, cost


@jax.jit
@jax.value_and_grad
def _cost_and_slope(values: Float[Array, " K"], mine: DecayProblem, strength: Float[Array, " T"]):
    """Of one microphone, kept with its axis of length one: compiled once for all of them."""
    return 0.5 * jnp.sum(mine.weight * mine.residual(values[:, None], strength) ** 2)


def log_covariance(
    problem: DecayProblem, logarithms: Float[Array, "K M"], strength: Float[Array, " T"], free: np.ndarray, scale
) -> np.ndarray:
    """Covariance (K M, K M) of the logarithms of parameters, parameter by parameter, where weights are inverse
    variances and the overall scale is fixed by `scale` · logarithms = constant, (K M,); NaN where not `free` (K, M)."""
    _, system = jax.jit(_normal_equations)(problem, logarithms, strength, jnp.asarray(free))
    schur = np.array(_schur(system, 0.0))
    number, count = logarithms.shape
    kept = np.asarray(free).ravel()
    shift = np.concatenate([np.ones(count), np.zeros((number - 1) * count)])[kept]
    normal = np.asarray(scale)[kept]
    result = np.full((number * count, number * count), np.nan)
    # The direction that data cannot see (all responses up, all strengths down) is projected along onto the convention.
    inverse = np.linalg.pinv(schur[np.ix_(kept, kept)], rcond=1e-12, hermitian=True)
    project = np.eye(len(shift)) - np.outer(shift, normal) / (normal @ shift)
    result[np.ix_(kept, kept)] = project @ inverse @ project.T
    return result


class _System(eqx.Module):
    """Normal equations: microphones' blocks (M, K, K), coupling (K, M, T) to the strengths, their diagonal (T,)."""

    matrix: Array
    coupling: Array
    tap_matrix: Array
    gradient: Array
    tap_gradient: Array
    free: Array


def _normal_equations(problem: DecayProblem, values, strengths, free) -> tuple[Array, _System]:
    mean, share, slopes = problem.expected(values, strengths)
    off = jnp.where(problem.weight > 0, problem.level - mean, 0.0)
    weight = problem.weight
    cost = 0.5 * jnp.sum(weight * off**2)
    jacobian = jnp.where(free[:, :, None], share * slopes, 0.0)
    weighted = weight * jacobian
    system = _System(
        matrix=jnp.einsum("kmt,lmt->mkl", weighted, jacobian),
        coupling=weighted * share,
        tap_matrix=jnp.sum(weight * share**2, axis=0),
        gradient=-jnp.sum(weighted * off, axis=-1),
        tap_gradient=-jnp.sum(weight * share * off, axis=0),
        free=free,
    )
    return cost, system


def _step(system: _System, damping):
    number, count = system.gradient.shape
    diagonal = _tap_diagonal(system, damping)
    schur = _schur(system, damping)
    # What data cannot see, all responses up and all strengths down, is held; so are parameters that are not free.
    shift = jnp.concatenate([jnp.where(system.free[0], 1.0, 0.0), jnp.zeros((number - 1) * count)])
    typical = jnp.trace(schur) / schur.shape[0] + 1e-300
    held = ~system.free.ravel()
    schur = schur + typical * (jnp.outer(shift, shift) / count + jnp.diag(jnp.where(held, 1.0, 1e-14)))
    right = -system.gradient + jnp.einsum("kmt,t->km", system.coupling, system.tap_gradient / diagonal)
    change = solve_definite(schur, right.ravel()).reshape(number, count)
    shifts = -(system.tap_gradient + jnp.einsum("kmt,km->t", system.coupling, change)) / diagonal
    return change, shifts


def _tap_diagonal(system: _System, damping):
    return jnp.where(system.tap_matrix > 0, system.tap_matrix * (1 + damping), 1.0)


def _schur(system: _System, damping):
    number, count = system.gradient.shape
    size = number * count
    blocks = system.matrix * (1 + damping * jnp.eye(number))
    index = jnp.arange(count)
    full = jnp.zeros((number, count, number, count)).at[:, index, :, index].set(blocks).reshape(size, size)
    coupling = system.coupling.reshape(size, -1)
    return full - (coupling / _tap_diagonal(system, damping)) @ coupling.T
