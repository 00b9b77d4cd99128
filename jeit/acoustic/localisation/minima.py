"""Descents: from starting places to minima on the skin, of any of the objectives, and their derivatives.

An objective has `microphone_array`, `frames` (all that differs from frame to frame), `cost`, `expand`, `start`, and
`features` and `screen` for candidate places: `Likelihood` and `Consistency` do.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jeit.acoustic.surface import bounding_box, longer_side, outline_sides
from jeit_solvers import Minimum, definite_small, hessian_small, minimise_small, solve_small

# Places screened along the outline.
_EDGE = 240
# Two valleys closer than this part of the skin's size are one.
_SAME_VALLEY = 0.05
# Steps into a second valley before it is compared with the first, and by how much its cost may then be greater.
_TRIAL_STEPS, _PROMISING, _MOST_STEPS = 8, 8.0, 30
# What a step must promise, relative to the cost; an exact Newton step follows.
_TOLERANCE = 1e-12


def find_minima(objective, first, second, worth):
    """From both starts (2, F), the second only where that is worth it: unknowns (n, F), by how much the outline costs
    more than what lies beyond, by how much the rival valley does, whether converged, and the (start, end) of the side
    of the outline on which frames were held, NaN for those inside."""
    surface = objective.microphone_array.surface
    found = _minimise(objective, objective.start(first), None)
    unknowns, converged = found.x, found.converged
    value = jnp.where(jnp.isfinite(found.value), found.value, jnp.inf)
    within = surface.outline.contains(unknowns[:2].T)
    rival, least = jnp.full(value.shape, jnp.inf), value
    if worth is not None:
        # A few steps show whether that valley is any good; only then is its bottom sought.
        tried = _minimise(objective, objective.start(second), ~worth, max_steps=_TRIAL_STEPS)
        worth = worth & (tried.value < value + _PROMISING)
        other = _minimise(objective, tried.x, ~worth)
        other_value = jnp.where(worth & jnp.isfinite(other.value), other.value, jnp.inf)
        other_within = surface.outline.contains(other.x[:2].T)
        apart = jnp.linalg.norm(other.x[:2] - unknowns[:2], axis=0) > _SAME_VALLEY * longer_side(surface)
        rival = jnp.where(apart & worth & within & other_within, jnp.abs(other_value - value), jnp.inf)
        least = jnp.minimum(value, other_value)
        # Of two valleys of which one lies beyond the outline, the other is taken; the outline itself may yet be better.
        better = jnp.where(other_within == within, other_value < value, other_within & jnp.isfinite(other_value))
        unknowns = jnp.where(better, other.x, unknowns)
        converged = jnp.where(better, other.converged, converged)
        value, within = jnp.where(better, other_value, value), jnp.where(better, other_within, within)
    # Places beyond the outline give way to the best on it; so do valleys inside that are worse than one beyond.
    beyond = jnp.isfinite(value) & (~within | (least < value))
    nowhere = jnp.full((2, 2, value.size), jnp.nan)

    def hold(_):
        held, side = _on_edge(objective, ~beyond)
        moved = beyond & (~within | (held.value < value))
        return (
            jnp.where(moved, held.x, unknowns),
            jnp.where(beyond, jnp.where(moved, held.value, value) - least, 0.0),
            jnp.where(moved, held.converged, converged),
            jnp.where(moved, side, nowhere),
        )

    def leave(_):
        return unknowns, jnp.zeros_like(value), converged, nowhere

    unknowns, excess, converged, side = jax.lax.cond(jnp.any(beyond), hold, leave, None)
    return unknowns, excess, rival, converged, side


def _minimise(objective, start, skip, *, max_steps: int | None = None) -> Minimum:
    """Within three times the outline's box; steps of at most a quarter of the skin, and a factor of ten in strength.

    The last of many steps are taken with exact Hessians; the first `max_steps`, where so many are asked for, are not.
    """
    surface = objective.microphone_array.surface
    low, high = bounding_box(surface)
    rest = jnp.full(start.shape[0] - 2, jnp.inf)
    reach = longer_side(surface)

    def of(frames):
        return type(objective)(*frames, objective.microphone_array)

    return minimise_small(
        lambda x, frames: of(frames).expand(x),
        start,
        objective.frames,
        finish=None if max_steps is not None else lambda x, frames: _exactly(of(frames), x),
        max_steps=max_steps or _MOST_STEPS,
        lower=jnp.concatenate([low - reach, -rest])[:, None],
        upper=jnp.concatenate([high + reach, rest])[:, None],
        largest_step=jnp.concatenate([jnp.full(2, reach / 4), jnp.full_like(rest, 2.3)])[:, None],
        tolerance=_TOLERANCE,
        skip=skip,
    )


def _exactly(objective, x) -> tuple[Array, Array, Array]:
    """The objective's expansion with the exact Hessian, where that is positive definite: near a minimum the last steps
    are few then, however badly the minimum fits."""
    value, gradient, model = objective.expand(x)
    hessian = hessian_small(objective.cost, x)
    return value, gradient, jnp.where(definite_small(hessian), hessian, model)


def _on_edge(objective, skip) -> tuple[Minimum, Array]:
    """The best place on the outline: the best of many, refined along its side. Also the side, (2, 2, F).

    Not of the frames to `skip` (F,).
    """
    start, end = outline_sides(objective.microphone_array.surface)
    length = jnp.linalg.norm(end - start, axis=0)
    # Places at equal steps along the whole outline, as (side, share of the side).
    stops = jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])
    walked = stops[-1] * (jnp.arange(_EDGE) + 0.5) / _EDGE
    which = jnp.clip(jnp.searchsorted(stops, walked, side="right") - 1, 0, length.size - 1)
    share = (walked - stops[which]) / length[which]
    chart = start[:, which] + share * (end - start)[:, which]
    maps = objective.screen(type(objective).features(objective.microphone_array, chart))
    best = jnp.argmin(jnp.where(jnp.isnan(maps), jnp.inf, maps), axis=1)
    origin, along = start[:, which[best]], (end - start)[:, which[best]]
    first = objective.start(chart[:, best])[2:]

    def unknowns_of(z, origin, along):
        return jnp.concatenate([origin + z[0] * along, z[1:]])

    def expand(z, data):
        origin, along, frames = data
        some = type(objective)(*frames, objective.microphone_array)
        value, gradient, matrix = some.expand(unknowns_of(z, origin, along))
        turned = jnp.concatenate([jnp.sum(along * gradient[:2], axis=0)[None], gradient[2:]])
        rows = jnp.concatenate([jnp.einsum("kf,klf->lf", along, matrix[:2])[None], matrix[2:]])
        columns = jnp.concatenate([jnp.einsum("klf,lf->kf", rows[:, :2], along)[:, None], rows[:, 2:]], axis=1)
        return value, turned, columns

    rest = first.shape[0]
    found = minimise_small(
        expand,
        jnp.concatenate([share[best][None], first]),
        (origin, along, objective.frames),
        lower=jnp.array([0.0] + rest * [-jnp.inf])[:, None],
        upper=jnp.array([1.0] + rest * [jnp.inf])[:, None],
        largest_step=jnp.array([0.5] + rest * [2.3])[:, None],
        tolerance=_TOLERANCE,
        skip=skip,
    )
    end_of = origin + along
    corner = (found.x[0] <= 0) | (found.x[0] >= 1)
    # Held in a corner, a frame moves nowhere: its side has no length.
    side = jnp.stack([origin, jnp.where(corner, origin, end_of)])
    return Minimum(unknowns_of(found.x, origin, along), found.value, found.converged, found.steps), side


def differentiable_minima(objective, unknowns, side, reach):
    """The minimum as a function of everything in `objective`: one Newton step from it, x − H⁻¹ ∇cost, is zero in value
    and, H and x being constants, −H⁻¹ ∂∇cost in derivative, as the implicit function theorem has it."""
    at = jax.lax.stop_gradient(unknowns)

    def finite_cost(at):
        cost = objective.cost(at)
        return jnp.where(jnp.isfinite(cost), cost, 0.0)

    matrix = hessian_small(jax.lax.stop_gradient(objective).cost, at)
    gradient = jax.grad(lambda at: jnp.sum(finite_cost(at)))(at)
    # Frames held on the outline move along their side only: the rest of the step is projected out.
    held = ~jnp.isnan(side[0, 0])
    along = jnp.where(held, side[1] - side[0], 0.0)
    length = jnp.linalg.norm(jnp.where(along == 0, 1e-300, along), axis=0)
    along = jnp.where(length > 1e-12 * reach, along / length, 0.0)
    plane = jnp.where(held, along[:, None] * along[None], jnp.eye(2)[:, :, None])
    keep = jnp.zeros_like(matrix) + jnp.eye(len(at))[:, :, None]
    keep = keep.at[:2, :2].set(plane)
    gradient = jnp.einsum("klf,lf->kf", keep, gradient)
    inner = jnp.einsum("klf,lmf,mnf->knf", keep, matrix, keep)
    trace = jnp.maximum(jnp.einsum("kkf->f", inner), 1e-300)
    matrix = inner + (jnp.eye(len(at))[:, :, None] - keep) * trace
    step = solve_small(matrix, gradient)
    usable = jnp.all(jnp.isfinite(step), axis=0) & (jnp.max(jnp.abs(step[:2]), axis=0) < 1e-3 * reach)
    return at - jnp.where(usable, step, 0.0)
