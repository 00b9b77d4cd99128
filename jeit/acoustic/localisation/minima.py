"""Descents: from starting places to minima on the skin, of any of the objectives, and their derivatives.

An objective has `microphone_array`, `frames` (all that differs from frame to frame), `cost`, `expand`, `start`, and
`features` and `screen` for candidate places: `Likelihood` and `Consistency` do.
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array

from jeit.acoustic.surface import bounding_box, longer_side, outline_sides
from jeit_solvers import Minimum, definite_small, gradient_small, hessian_small, minimise_small, solve_small
from jeit_solvers.engines import namespace, set_at, undifferentiated

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
    xp = namespace(objective, unknowns)
    value = xp.where(xp.isfinite(found.value), found.value, xp.inf)
    within = surface.outline.contains(unknowns[:2].T)
    rival, least = xp.full(value.shape, xp.inf), value
    if worth is not None:
        # A few steps show whether that valley is any good; only then is its bottom sought.
        tried = _minimise(objective, objective.start(second), ~worth, max_steps=_TRIAL_STEPS)
        worth = worth & (tried.value < value + _PROMISING)
        other = _minimise(objective, tried.x, ~worth)
        other_value = xp.where(worth & xp.isfinite(other.value), other.value, xp.inf)
        other_within = surface.outline.contains(other.x[:2].T)
        apart = xp.linalg.norm(other.x[:2] - unknowns[:2], axis=0) > _SAME_VALLEY * longer_side(surface)
        rival = xp.where(apart & worth & within & other_within, xp.abs(other_value - value), xp.inf)
        least = xp.minimum(value, other_value)
        # Of two valleys of which one lies beyond the outline, the other is taken; the outline itself may yet be better.
        better = xp.where(other_within == within, other_value < value, other_within & xp.isfinite(other_value))
        unknowns = xp.where(better, other.x, unknowns)
        converged = xp.where(better, other.converged, converged)
        value, within = xp.where(better, other_value, value), xp.where(better, other_within, within)
    # Places beyond the outline give way to the best on it; so do valleys inside that are worse than one beyond.
    beyond = xp.isfinite(value) & (~within | (least < value))
    nowhere = xp.full((2, 2, value.size), xp.nan)

    def hold(_):
        held, side = _on_edge(objective, ~beyond)
        moved = beyond & (~within | (held.value < value))
        return (
            xp.where(moved, held.x, unknowns),
            xp.where(beyond, xp.where(moved, held.value, value) - least, 0.0),
            xp.where(moved, held.converged, converged),
            xp.where(moved, side, nowhere),
        )

    def leave(_):
        return unknowns, xp.zeros_like(value), converged, nowhere

    some = xp.any(beyond)
    held = (hold(None) if some else leave(None)) if xp is np else jax.lax.cond(some, hold, leave, None)
    unknowns, excess, converged, side = held
    return unknowns, excess, rival, converged, side


def _minimise(objective, start, skip, *, max_steps: int | None = None) -> Minimum:
    """Within three times the outline's box; steps of at most a quarter of the skin, and a factor of ten in strength.

    The last of many steps are taken with exact Hessians; the first `max_steps`, where so many are asked for, are not.
    """
    surface = objective.microphone_array.surface
    low, high = bounding_box(surface)
    xp = namespace(objective, start)
    rest = xp.full(start.shape[0] - 2, xp.inf)
    reach = longer_side(surface)

    def of(frames):
        return type(objective)(*frames, objective.microphone_array)

    return minimise_small(
        lambda x, frames: of(frames).expand(x),
        start,
        objective.frames,
        finish=None if max_steps is not None else lambda x, frames: _exactly(of(frames), x),
        max_steps=max_steps or _MOST_STEPS,
        lower=xp.concatenate([low - reach, -rest])[:, None],
        upper=xp.concatenate([high + reach, rest])[:, None],
        largest_step=xp.concatenate([xp.full(2, reach / 4), xp.full_like(rest, 2.3)])[:, None],
        tolerance=_TOLERANCE,
        skip=skip,
    )


def _exactly(objective, x) -> tuple[Array, Array, Array]:
    """The objective's expansion with the exact Hessian, where that is positive definite: near a minimum the last steps
    are few then, however badly the minimum fits."""
    value, gradient, model = objective.expand(x)
    hessian = hessian_small(objective.cost, x)
    return value, gradient, namespace(hessian).where(definite_small(hessian), hessian, model)


def _on_edge(objective, skip) -> tuple[Minimum, Array]:
    """The best place on the outline: the best of many, refined along its side. Also the side, (2, 2, F).

    Not of the frames to `skip` (F,).
    """
    start, end = outline_sides(objective.microphone_array.surface)
    xp = namespace(objective, start)
    length = xp.linalg.norm(end - start, axis=0)
    # Places at equal steps along the whole outline, as (side, share of the side).
    stops = xp.concatenate([xp.zeros(1), xp.cumsum(length)])
    walked = stops[-1] * (xp.arange(_EDGE) + 0.5) / _EDGE
    which = xp.clip(xp.searchsorted(stops, walked, side="right") - 1, 0, length.size - 1)
    share = (walked - stops[which]) / length[which]
    chart = start[:, which] + share * (end - start)[:, which]
    maps = objective.screen(type(objective).features(objective.microphone_array, chart))
    best = xp.argmin(xp.where(xp.isnan(maps), xp.inf, maps), axis=1)
    origin, along = start[:, which[best]], (end - start)[:, which[best]]
    first = objective.start(chart[:, best])[2:]

    def unknowns_of(z, origin, along):
        return xp.concatenate([origin + z[0] * along, z[1:]])

    def expand(z, data):
        origin, along, frames = data
        some = type(objective)(*frames, objective.microphone_array)
        value, gradient, matrix = some.expand(unknowns_of(z, origin, along))
        turned = xp.concatenate([xp.sum(along * gradient[:2], axis=0)[None], gradient[2:]])
        rows = xp.concatenate([xp.einsum("kf,klf->lf", along, matrix[:2])[None], matrix[2:]])
        columns = xp.concatenate([xp.einsum("klf,lf->kf", rows[:, :2], along)[:, None], rows[:, 2:]], axis=1)
        return value, turned, columns

    rest = first.shape[0]
    found = minimise_small(
        expand,
        xp.concatenate([share[best][None], first]),
        (origin, along, objective.frames),
        lower=xp.array([0.0] + rest * [-xp.inf])[:, None],
        upper=xp.array([1.0] + rest * [xp.inf])[:, None],
        largest_step=xp.array([0.5] + rest * [2.3])[:, None],
        tolerance=_TOLERANCE,
        skip=skip,
    )
    end_of = origin + along
    corner = (found.x[0] <= 0) | (found.x[0] >= 1)
    # Held in a corner, a frame moves nowhere: its side has no length.
    side = xp.stack([origin, xp.where(corner, origin, end_of)])
    return Minimum(unknowns_of(found.x, origin, along), found.value, found.converged, found.steps), side


def differentiable_minima(objective, unknowns, side, reach):
    """The minimum as a function of everything in `objective`: one Newton step from it, x − H⁻¹ ∇cost, is zero in value
    and, H and x being constants, −H⁻¹ ∂∇cost in derivative, as the implicit function theorem has it."""
    at, xp = undifferentiated(unknowns), namespace(objective, unknowns)

    def finite_cost(at):
        cost = objective.cost(at)
        return xp.where(xp.isfinite(cost), cost, 0.0)

    matrix = hessian_small(undifferentiated(objective).cost, at)
    gradient = gradient_small(finite_cost, at)
    # Frames held on the outline move along their side only: the rest of the step is projected out.
    held = ~xp.isnan(side[0, 0])
    along = xp.where(held, side[1] - side[0], 0.0)
    length = xp.linalg.norm(xp.where(along == 0, 1e-300, along), axis=0)
    along = xp.where(length > 1e-12 * reach, along / length, 0.0)
    plane = xp.where(held, along[:, None] * along[None], xp.eye(2)[:, :, None])
    keep = set_at(xp.zeros_like(matrix) + xp.eye(len(at))[:, :, None], np.s_[:2, :2], plane)
    gradient = xp.einsum("klf,lf->kf", keep, gradient)
    inner = xp.einsum("klf,lmf,mnf->knf", keep, matrix, keep)
    trace = xp.maximum(xp.einsum("kkf->f", inner), 1e-300)
    matrix = inner + (xp.eye(len(at))[:, :, None] - keep) * trace
    step = solve_small(matrix, gradient)
    usable = xp.all(xp.isfinite(step), axis=0) & (xp.max(xp.abs(step[:2]), axis=0) < 1e-3 * reach)
    return at - xp.where(usable, step, 0.0)
