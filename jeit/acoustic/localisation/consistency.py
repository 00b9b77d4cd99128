"""The intensity-consistency loss, and the search for its minima.

Intensity consistency: at the source, the strengths estimated from all microphones by their distances are equal.

The loss of Park 2022, text S2, with g_i = 1 / f_i and k the loudest microphone:

    L(u) = Σ_{i≠k} (I_k g_k(u) − I_i g_i(u))².

The loss ignores noise: far microphones count as much as near ones, multiplied by the distance. Frames are the last axis
of all arrays here, microphones the first; intensities are relative to the loudest.

Minimisation of an objective on the skin from given starting positions, with derivatives of the minimum.

An objective, `Likelihood` or `Consistency`, has `microphone_array`, `frames` (the arrays that differ between frames),
`cost`, `expand`, `start`, and `features` and `screen` for candidate positions.
"""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.microphones import MicrophoneArray
from jeit.acoustic.surface import bounding_box, longer_side, outline_sides
from jeit_solvers import (
    Minimum,
    definite_small,
    gradient_small,
    hessian_small,
    inverse_small,
    minimise_small,
    solve_small,
    symmetric_small,
)
from jeit_solvers.engines import kept, namespace, set_at, slopes, undifferentiated


class Consistency(eqx.Module):
    """Consistency loss of F frames: `power` relative to the `loudest` (F,) of the microphones in `use` (M, F)."""

    power: Float[Array, "M F"]
    loudest: Int[Array, " F"]
    scale: Float[Array, " F"]
    use: Bool[Array, "M F"]
    microphone_array: MicrophoneArray

    @classmethod
    def create(
        cls, power: Float[Array, "M F"], use: Bool[Array, "M F"], microphone_array: MicrophoneArray
    ) -> "Consistency":
        """Create the loss from intensities; unused values are ignored and may be NaN."""
        xp = namespace(power, use)
        known = xp.where(use, power, 0.0)
        scale = xp.max(known, axis=0)
        loudest = xp.argmax(known, axis=0)
        return cls(known / xp.where(scale > 0, scale, 1.0), loudest, scale, use, microphone_array)

    @property
    def frames(self) -> tuple[Array, ...]:
        """The arrays that differ between frames."""
        return self.power, self.loudest, self.scale, self.use

    def differences(self, chart: Float[Array, "2 F"]) -> Float[Array, "M F"]:
        """Differences I_k g_k − I_i g_i; 0 where not used."""
        estimates = self.power / self.microphone_array.response(chart)
        xp = namespace(self, estimates)
        most = xp.take_along_axis(estimates, self.loudest[None], axis=0)
        return xp.where(self.use, most - estimates, 0.0)

    def cost(self, chart: Float[Array, "2 F"]) -> Float[Array, " F"]:
        """The loss L, relative to the square of the loudest intensity."""
        return (self.differences(chart) ** 2).sum(axis=0)

    def expand(self, chart: Float[Array, "2 F"]) -> tuple[Array, Array, Array]:
        """Loss, gradient, and Gauss-Newton matrix."""
        off, along = kept(slopes(self.differences, chart))
        gradient = 2 * namespace(off).stack([(off * slope).sum(axis=0) for slope in along])
        rows = [[2 * (one * other).sum(axis=0) for other in along[: k + 1]] for k, one in enumerate(along)]
        return (off**2).sum(axis=0), gradient, symmetric_small(rows)

    def start(self, chart: Float[Array, "2 F"]) -> Float[Array, "2 F"]:
        """Initial unknowns: the chart coordinates."""
        return chart

    @staticmethod
    def features(microphone_array: MicrophoneArray, chart: Float[Array, "2 P"]) -> Float[Array, "N P"]:
        """Features of candidate positions for `screen`: the ten products of pairs of (|x|², x, y, 1) where 1 / f is (|x
        − x_i|² + b) / a, on a surface in space fifteen; responses f (M, P) for other models."""
        if not isinstance(microphone_array.decay, InverseSquare):
            return microphone_array.response(chart)
        place = microphone_array.surface.place(chart)
        xp = namespace(place)
        terms = [xp.sum(place**2, axis=0), *place, xp.ones_like(place[0])]
        return xp.stack([terms[i] * terms[j] for i in range(len(terms)) for j in range(i + 1)])

    def screen(self, features: Float[Array, "N P"]) -> Float[Array, "F P"]:
        """The loss at candidate positions, by matrix products for all frames and positions.

        With A = I_k g_k and n microphones in use it is n A² − 2 A Σ I_i g_i + Σ I_i² g_i². Where g is quadratic in the
        position, the loss is a polynomial of the fourth degree: ten coefficients per frame and one product."""
        xp = namespace(self, features)
        number = xp.sum(self.use, axis=0)
        if not isinstance(self.microphone_array.decay, InverseSquare):
            inverse = 1 / features
            most = xp.take(inverse, self.loudest, axis=0)
            return (number[:, None] * most - 2 * (self.power.T @ inverse)) * most + (self.power.T**2) @ inverse**2
        decay, where = self.microphone_array.decay, self.microphone_array.microphones
        constant = xp.sum(where**2, axis=1) + decay.b
        quadratic = xp.column_stack([xp.ones(len(where)), -2 * where, constant]) / decay.a[:, None]
        estimates = [self.power * column[:, None] for column in quadratic.T]
        most = [xp.take_along_axis(each, self.loudest[None], axis=0)[0] for each in estimates]
        total = [xp.sum(each, axis=0) for each in estimates]
        coefficients = []
        for i in range(len(estimates)):
            for j in range(i + 1):
                both = number * most[i] * most[j] - most[i] * total[j] - most[j] * total[i]
                both = both + xp.sum(estimates[i] * estimates[j], axis=0)
                coefficients.append(both if i == j else 2 * both)
        return xp.stack(coefficients, axis=1) @ features

    def covariance(self, chart: Float[Array, "2 F"], strength: Float[Array, " F"]) -> Float[Array, "2 2 F"]:
        """Covariance of the minimum, from the variances of the intensities: Σ_i (∂u/∂I_i)(∂u/∂I_i)ᵀ var I_i, with the
        derivative of the minimum by the implicit function theorem, ∂u/∂I = −H⁻¹ ∂²L/∂u∂I at small differences."""
        estimates, along = slopes(lambda u: 1 / self.microphone_array.response(u), chart)
        xp = namespace(self, estimates)
        slope = xp.stack(along) * self.power
        most = xp.take_along_axis(slope, self.loudest[None, None], axis=1)
        rise = xp.where(self.use, most - slope, 0.0)
        matrix = xp.einsum("kmf,lmf->klf", rise, rise)
        # ∂/∂I_i of ½∂L/∂u: −g_i times the gradient of its difference; for the loudest, g_k times the sum over all.
        is_loudest = xp.arange(estimates.shape[0])[:, None] == self.loudest
        drive = xp.where(is_loudest, xp.sum(rise, axis=1, keepdims=True) * estimates, -estimates * rise)
        received = strength / estimates
        variance = self.microphone_array.noise.variance(received) / xp.where(self.scale > 0, self.scale, 1.0) ** 2
        spread = xp.einsum("kmf,lmf,mf->klf", drive, drive, xp.where(self.use, variance, 0.0))
        inverse = inverse_small(matrix)
        return xp.einsum("ijf,jkf,klf->ilf", inverse, spread, inverse)


# Positions screened along the outline.
_EDGE = 240
# Valleys closer than this fraction of the skin's size are the same.
_SAME_VALLEY = 0.05
# Steps into a second valley before it is compared with the first, and the largest cost difference to continue with.
_TRIAL_STEPS, _PROMISING, _MOST_STEPS = 8, 8.0, 30
# Least predicted decrease of a step, relative to the cost; an exact Newton step follows.
_TOLERANCE = 1e-12


def find_minima(objective, first, second, worth):
    """Minimise from both starts (2, F), the second only where it is promising.

    Returns the unknowns (n, F), the excess cost of the outline over the minimum beyond it, the excess cost of the rival
    valley, whether converged, and the (start, end) of the side of the outline on which frames were held, NaN for those
    inside."""
    surface = objective.microphone_array.surface
    found = _minimise(objective, objective.start(first), None)
    unknowns, converged = found.x, found.converged
    xp = namespace(objective, unknowns)
    value = xp.where(xp.isfinite(found.value), found.value, xp.inf)
    within = surface.outline.contains(unknowns[:2].T)
    rival, least = xp.full(value.shape, xp.inf), value
    if worth is not None:
        # After a few steps, only promising valleys are minimised further.
        tried = _minimise(objective, objective.start(second), ~worth, max_steps=_TRIAL_STEPS)
        worth = worth & (tried.value < value + _PROMISING)
        other = _minimise(objective, tried.x, ~worth)
        other_value = xp.where(worth & xp.isfinite(other.value), other.value, xp.inf)
        other_within = surface.outline.contains(other.x[:2].T)
        apart = xp.linalg.norm(other.x[:2] - unknowns[:2], axis=0) > _SAME_VALLEY * longer_side(surface)
        rival = xp.where(apart & worth & within & other_within, xp.abs(other_value - value), xp.inf)
        least = xp.minimum(value, other_value)
        # If one of two valleys lies beyond the outline, the other is taken; the outline itself may still be better.
        better = xp.where(other_within == within, other_value < value, other_within & xp.isfinite(other_value))
        unknowns = xp.where(better, other.x, unknowns)
        converged = xp.where(better, other.converged, converged)
        value, within = xp.where(better, other_value, value), xp.where(better, other_within, within)
    # Positions beyond the outline are replaced by the best on it; so are valleys inside that are worse than one beyond.
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
    """Minimise within three times the outline's box, in steps of at most a quarter of the skin and a factor of ten in
    strength.

    The last steps use exact Hessians, unless `max_steps` is given, which limits the number of steps without them.
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
    """The objective's expansion with the exact Hessian, where that is positive definite: few last steps are then needed
    near a minimum, however large its misfit."""
    value, gradient, model = objective.expand(x)
    hessian = hessian_small(objective.cost, x)
    return value, gradient, namespace(hessian).where(definite_small(hessian), hessian, model)


def _on_edge(objective, skip) -> tuple[Minimum, Array]:
    """The best position on the outline: the best of many, refined along its side. Also returns the side, (2, 2, F).

    Frames in `skip` (F,) are left out.
    """
    start, end = outline_sides(objective.microphone_array.surface)
    xp = namespace(objective, start)
    length = xp.linalg.norm(end - start, axis=0)
    # Positions at equal steps along the whole outline, as (side, fraction of the side).
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
    # A frame held in a corner cannot move: its side has length zero.
    side = xp.stack([origin, xp.where(corner, origin, end_of)])
    return Minimum(unknowns_of(found.x, origin, along), found.value, found.converged, found.steps), side


def differentiable_minima(objective, unknowns, side, reach):
    """The minimum as a differentiable function of everything in `objective`. One Newton step from it, x − H⁻¹ ∇cost,
    adds zero to the value and, with H and x constant, −H⁻¹ ∂∇cost to the derivative, by the implicit function
    theorem."""
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
