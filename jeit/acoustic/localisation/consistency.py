"""Intensity-consistency loss, and minimisation of objectives on a skin.

Each microphone gives an estimate of the strength of a source at u: its intensity I_i multiplied by g_i(u) = 1 / f_i(u).
At the true position, the estimates of all microphones are equal. The loss of Park 2022, text S2, is

    L(u) = Σ_{i≠k} (I_k g_k(u) − I_i g_i(u))²,

where k is the microphone with the highest intensity. The loss does not take noise into account: since g_i increases
with distance, it amplifies the noise of distant microphones. Microphones are the first axis of all arrays, and frames
the last. Intensities are divided by the highest intensity of the frame.

The functions for minimisation find the minimum of an objective from given starting positions, and the derivatives of
the minimum. An objective, `Likelihood` or `Consistency`, has the attributes `microphone_array`, `frames` (the arrays
that differ between frames), `cost`, `expand`, `start`, and, for candidate positions, `features` and `screen`.
"""

from __future__ import annotations

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
from jeit_solvers.module import Module


class Consistency(Module):
    """Consistency loss of F frames.

    **Fields**: `power`: intensities (M, F) divided by the highest intensity of the frame; `loudest`: index (F,) of the
    microphone with the highest intensity; `scale`: that intensity (F,); `use`: mask (M, F) of the intensities used;
    `microphone_array`: model of the array.
    """

    power: Float[Array, "M F"]
    loudest: Int[Array, " F"]
    scale: Float[Array, " F"]
    use: Bool[Array, "M F"]
    microphone_array: MicrophoneArray

    @classmethod
    def create(
        cls, power: Float[Array, "M F"], use: Bool[Array, "M F"], microphone_array: MicrophoneArray
    ) -> "Consistency":
        """Create the loss from intensities `power`. Values outside the mask `use` are ignored and may be NaN."""
        xp = namespace(power, use)
        known = xp.where(use, power, 0.0)
        scale = xp.max(known, axis=0)
        loudest = xp.argmax(known, axis=0)
        return cls(known / xp.where(scale > 0, scale, 1.0), loudest, scale, use, microphone_array)

    @property
    def frames(self) -> tuple[Array, ...]:
        """Fields whose last axis is the frame."""
        return self.power, self.loudest, self.scale, self.use

    def differences(self, chart: Float[Array, "2 F"]) -> Float[Array, "M F"]:
        """Differences I_k g_k − I_i g_i of the estimated strengths; 0 where not used."""
        estimates = self.power / self.microphone_array.response(chart)
        xp = namespace(self, estimates)
        most = xp.take_along_axis(estimates, self.loudest[None], axis=0)
        return xp.where(self.use, most - estimates, 0.0)

    def cost(self, chart: Float[Array, "2 F"]) -> Float[Array, " F"]:
        """Loss L divided by the square of the highest intensity."""
        return (self.differences(chart) ** 2).sum(axis=0)

    def expand(self, chart: Float[Array, "2 F"]) -> tuple[Array, Array, Array]:
        """Loss, its gradient (2, F), and its Gauss-Newton matrix (2, 2, F)."""
        off, along = kept(slopes(self.differences, chart))
        gradient = 2 * namespace(off).stack([(off * slope).sum(axis=0) for slope in along])
        rows = [[2 * (one * other).sum(axis=0) for other in along[: k + 1]] for k, one in enumerate(along)]
        return (off**2).sum(axis=0), gradient, symmetric_small(rows)

    def start(self, chart: Float[Array, "2 F"]) -> Float[Array, "2 F"]:
        """Initial unknowns of a minimisation: the chart coordinates."""
        return chart

    @staticmethod
    def features(microphone_array: MicrophoneArray, chart: Float[Array, "2 P"]) -> Float[Array, "N P"]:
        """Features of candidate positions for `screen`.

        For the inverse-square model, 1 / f = (|x − x_i|² + b) / a, they are the ten products of pairs of (|x|², x, y,
        1), or the fifteen products of pairs of (|x|², x, y, z, 1) in space. For other models they are the responses f
        (M, P).
        """
        if not isinstance(microphone_array.decay, InverseSquare):
            return microphone_array.response(chart)
        place = microphone_array.surface.place(chart)
        xp = namespace(place)
        terms = [xp.sum(place**2, axis=0), *place, xp.ones_like(place[0])]
        return xp.stack([terms[i] * terms[j] for i in range(len(terms)) for j in range(i + 1)])

    def screen(self, features: Float[Array, "N P"]) -> Float[Array, "F P"]:
        """Loss (F, P) of all frames at candidate positions, computed by matrix products.

        With A = I_k g_k and n microphones in use, the loss is n A² − 2 A Σ I_i g_i + Σ I_i² g_i². For the
        inverse-square model, g is quadratic in the position, so the loss is a polynomial of degree four; it is computed
        as the product of its coefficients and the features.
        """
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
        """Covariance of the minimum u, from the variances of the intensities: Σ_i (∂u/∂I_i)(∂u/∂I_i)ᵀ var I_i.

        The implicit function theorem gives the derivative of the minimum, ∂u/∂I = −H⁻¹ ∂²L/∂u∂I. Second derivatives are
        approximated for small differences I_k g_k − I_i g_i.
        """
        estimates, along = slopes(lambda u: 1 / self.microphone_array.response(u), chart)
        xp = namespace(self, estimates)
        slope = xp.stack(along) * self.power
        most = xp.take_along_axis(slope, self.loudest[None, None], axis=1)
        rise = xp.where(self.use, most - slope, 0.0)
        matrix = xp.einsum("kmf,lmf->klf", rise, rise)
        # Derivative of ½ ∂L/∂u with respect to I_i: −g_i times the gradient of the difference of microphone i. For the
        # loudest microphone k it is g_k times the sum of these gradients over all microphones.
        is_loudest = xp.arange(estimates.shape[0])[:, None] == self.loudest
        drive = xp.where(is_loudest, xp.sum(rise, axis=1, keepdims=True) * estimates, -estimates * rise)
        received = strength / estimates
        variance = self.microphone_array.noise.variance(received) / xp.where(self.scale > 0, self.scale, 1.0) ** 2
        spread = xp.einsum("kmf,lmf,mf->klf", drive, drive, xp.where(self.use, variance, 0.0))
        inverse = inverse_small(matrix)
        return xp.einsum("ijf,jkf,klf->ilf", inverse, spread, inverse)


# Number of candidate positions along the outline.
_OUTLINE_CANDIDATES = 240
# Distance, as a fraction of the skin's size, below which two minima are considered the same.
_SAME_VALLEY = 0.05
# Number of steps in the second valley before its cost is compared with that of the first; maximum difference of cost
# for which the minimisation continues; maximum number of steps of a minimisation.
_TRIAL_STEPS, _MOST_EXCESS, _MOST_STEPS = 8, 8.0, 30
# Tolerance of the minimisation: predicted decrease of the cost in the next step, relative to 1 + |cost|.
_TOLERANCE = 1e-12


def find_minima(objective, first, second, try_second):
    """Minimise the objective from the starting positions `first` and `second` (2, F).

    `try_second`: mask of the frames for which the second start is tried, or None for none; it is given up if it is not
    promising. Returns the unknowns (n, F) at the minimum; the cost on the outline minus the cost of the minimum beyond
    it; the difference of cost between the two minima; whether the minimisation converged; and the start and end (2, 2,
    F) of the side of the outline to which the position was moved, NaN for positions inside.
    """
    surface = objective.microphone_array.surface
    found = _minimise(objective, objective.start(first), None)
    unknowns, converged = found.x, found.converged
    xp = namespace(objective, unknowns)
    value = xp.where(xp.isfinite(found.value), found.value, xp.inf)
    within = surface.outline.contains(unknowns[:2].T)
    rival, least = xp.full(value.shape, xp.inf), value
    if try_second is not None:
        # After a few steps, the minimisation continues only in promising second valleys.
        tried = _minimise(objective, objective.start(second), ~try_second, max_steps=_TRIAL_STEPS)
        try_second = try_second & (tried.value < value + _MOST_EXCESS)
        other = _minimise(objective, tried.x, ~try_second)
        other_value = xp.where(try_second & xp.isfinite(other.value), other.value, xp.inf)
        other_within = surface.outline.contains(other.x[:2].T)
        apart = xp.linalg.norm(other.x[:2] - unknowns[:2], axis=0) > _SAME_VALLEY * longer_side(surface)
        rival = xp.where(apart & try_second & within & other_within, xp.abs(other_value - value), xp.inf)
        least = xp.minimum(value, other_value)
        # If one of the two minima is outside the outline, the other is selected. A position on the outline may still be
        # better.
        better = xp.where(other_within == within, other_value < value, other_within & xp.isfinite(other_value))
        unknowns = xp.where(better, other.x, unknowns)
        converged = xp.where(better, other.converged, converged)
        value, within = xp.where(better, other_value, value), xp.where(better, other_within, within)
    # Minima outside the outline are replaced by the best position on the outline. A minimum inside is also compared
    # with it, if the other minimum, outside, has a lower cost.
    beyond = xp.isfinite(value) & (~within | (least < value))
    nowhere = xp.full((2, 2, value.size), xp.nan)

    def move_to_outline(_):
        held, side = _minimise_on_outline(objective, ~beyond)
        moved = beyond & (~within | (held.value < value))
        return (
            xp.where(moved, held.x, unknowns),
            xp.where(beyond, xp.where(moved, held.value, value) - least, 0.0),
            xp.where(moved, held.converged, converged),
            xp.where(moved, side, nowhere),
        )

    def keep_inside(_):
        return unknowns, xp.zeros_like(value), converged, nowhere

    some = xp.any(beyond)
    held = (
        (move_to_outline(None) if some else keep_inside(None))
        if xp is np
        else jax.lax.cond(some, move_to_outline, keep_inside, None)
    )
    unknowns, excess, converged, side = held
    return unknowns, excess, rival, converged, side


def _minimise(objective, start, skip, *, max_steps: int | None = None) -> Minimum:
    """Minimise the objective within the bounding box of the outline, extended by its longer side in all directions. A
    step is at most a quarter of that side, and a factor of ten in strength.

    `max_steps`: maximum number of steps, all with the approximate Hessian. By default, the last steps use the exact
    Hessian.
    """
    surface = objective.microphone_array.surface
    low, high = bounding_box(surface)
    xp = namespace(objective, start)
    rest = xp.full(start.shape[0] - 2, xp.inf)
    reach = longer_side(surface)

    def expand_frames(frames):
        return type(objective)(*frames, objective.microphone_array)

    return minimise_small(
        lambda x, frames: expand_frames(frames).expand(x),
        start,
        objective.frames,
        finish=None if max_steps is not None else lambda x, frames: _expand_exactly(expand_frames(frames), x),
        max_steps=max_steps or _MOST_STEPS,
        lower=xp.concatenate([low - reach, -rest])[:, None],
        upper=xp.concatenate([high + reach, rest])[:, None],
        largest_step=xp.concatenate([xp.full(2, reach / 4), xp.full_like(rest, 2.3)])[:, None],
        tolerance=_TOLERANCE,
        skip=skip,
    )


def _expand_exactly(objective, x) -> tuple[Array, Array, Array]:
    """Value, gradient and Hessian of the objective. The Hessian is exact where it is positive definite, so that few
    steps are needed near a minimum even if its misfit is large; elsewhere it is approximate."""
    value, gradient, model = objective.expand(x)
    hessian = hessian_small(objective.cost, x)
    return value, gradient, namespace(hessian).where(definite_small(hessian), hessian, model)


def _minimise_on_outline(objective, skip) -> tuple[Minimum, Array]:
    """Find the best position on the outline: the best of many candidates, refined along its side. Frames in the mask
    `skip` (F,) are left out. Also returns the start and end of the side (2, 2, F).
    """
    start, end = outline_sides(objective.microphone_array.surface)
    xp = namespace(objective, start)
    length = xp.linalg.norm(end - start, axis=0)
    # Candidate positions are equally spaced along the outline, and given by a side and a fraction of its length.
    stops = xp.concatenate([xp.zeros(1), xp.cumsum(length)])
    walked = stops[-1] * (xp.arange(_OUTLINE_CANDIDATES) + 0.5) / _OUTLINE_CANDIDATES
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
    # A position in a corner of the outline cannot move along a side, so its side is given the length zero.
    side = xp.stack([origin, xp.where(corner, origin, end_of)])
    return Minimum(unknowns_of(found.x, origin, along), found.value, found.converged, found.steps), side


def differentiable_minima(objective, unknowns, side, reach):
    """Return the minimum `unknowns` as a differentiable function of all arrays in `objective`.

    The result is a Newton step x − H⁻¹ ∇cost from the minimum x, with x and H held constant. The step is zero, and its
    derivative −H⁻¹ ∂∇cost is that of the minimum by the implicit function theorem. `side`: start and end of the side of
    the outline on which the minimum lies, or NaN. `reach`: size of the skin in metres.
    """
    at, xp = undifferentiated(unknowns), namespace(objective, unknowns)

    def finite_cost(at):
        cost = objective.cost(at)
        return xp.where(xp.isfinite(cost), cost, 0.0)

    matrix = hessian_small(undifferentiated(objective).cost, at)
    gradient = gradient_small(finite_cost, at)
    # Positions on the outline can move along their side only, so the step is projected onto the side.
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
