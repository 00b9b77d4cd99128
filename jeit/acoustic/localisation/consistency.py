"""Intensity-consistency loss, and minimisation of localisation objectives on a skin.

Each microphone i gives an estimate of the strength of a source at position u: its intensity I_i multiplied by g_i(u) =
1 / f_i(u), where f_i is its response. At the true position, the estimates of all microphones are equal. The loss of
Park 2022, text S2, is

    L(u) = Σ_{i≠k} (I_k g_k(u) − I_i g_i(u))²,

where k is the microphone with the highest intensity. The loss does not take noise into account: since g_i increases
with distance, the loss amplifies the noise of distant microphones. Microphones are the first axis of all arrays, and
frames the last. Intensities are divided by the highest intensity of the frame.

The functions for minimisation find the minimum of an objective from given starting positions, and the derivatives of
the minimum. An objective, `Likelihood` or `Consistency`, has the attributes `microphone_array`, `frames` (the arrays
that differ between frames), `cost`, `expand` and `start`, and the attributes `features` and `screen` for candidate
positions.
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
from jeit_solvers.engines import computed_once, namespace, set_at, slopes, undifferentiated
from jeit_solvers.module import Module


class Consistency(Module):
    """Intensity-consistency loss L of F frames, for the positions of one source per frame.

    **Fields**: `power`: intensities (M, F) divided by the highest intensity of the frame; `loudest`: index (F,) of the
    microphone with the highest intensity; `scale`: highest intensity (F,); `use`: mask (M, F) of the intensities used;
    `microphone_array`: model of the microphone array.
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
        """Create the loss from intensities `power`. Intensities outside the mask `use` are ignored and may be NaN."""
        xp = namespace(power, use)
        used_power = xp.where(use, power, 0.0)
        loudest_power = xp.max(used_power, axis=0)
        loudest_microphones = xp.argmax(used_power, axis=0)
        return cls(
            used_power / xp.where(loudest_power > 0, loudest_power, 1.0),
            loudest_microphones,
            loudest_power,
            use,
            microphone_array,
        )

    @property
    def frames(self) -> tuple[Array, ...]:
        """Fields of the loss whose last axis is the frame."""
        return self.power, self.loudest, self.scale, self.use

    def differences(self, chart: Float[Array, "2 F"]) -> Float[Array, "M F"]:
        """Differences I_k g_k − I_i g_i between the strengths that the loudest microphone k and microphone i indicate;
        0 where intensities are not used."""
        strength_estimates = self.power / self.microphone_array.response(chart)
        xp = namespace(self, strength_estimates)
        loudest_estimate = xp.take_along_axis(strength_estimates, self.loudest[None], axis=0)
        return xp.where(self.use, loudest_estimate - strength_estimates, 0.0)

    def cost(self, chart: Float[Array, "2 F"]) -> Float[Array, " F"]:
        """Consistency loss L (F,) divided by the square of the highest intensity."""
        return (self.differences(chart) ** 2).sum(axis=0)

    def expand(self, chart: Float[Array, "2 F"]) -> tuple[Array, Array, Array]:
        """Loss (F,), gradient (2, F) of the loss with respect to the chart coordinates, and Gauss-Newton matrix (2, 2,
        F)."""
        differences, loss_derivatives = computed_once(slopes(self.differences, chart))
        gradient = 2 * namespace(differences).stack(
            [(differences * loss_derivative).sum(axis=0) for loss_derivative in loss_derivatives]
        )
        matrix_rows = [
            [2 * (derivative_k * derivative_l).sum(axis=0) for derivative_l in loss_derivatives[: k + 1]]
            for k, derivative_k in enumerate(loss_derivatives)
        ]
        return (differences**2).sum(axis=0), gradient, symmetric_small(matrix_rows)

    def start(self, chart: Float[Array, "2 F"]) -> Float[Array, "2 F"]:
        """Initial unknowns of a minimisation of the loss: the chart coordinates."""
        return chart

    @staticmethod
    def features(microphone_array: MicrophoneArray, chart: Float[Array, "2 P"]) -> Float[Array, "N P"]:
        """Features of candidate positions for `screen`.

        For the inverse-square model, 1 / f = (|x − x_i|² + b) / a, the features are the ten products of pairs of (|x|²,
        x, y, 1), or the fifteen products of pairs of (|x|², x, y, z, 1) in space. For other decay models, the features
        are the responses f (M, P).
        """
        if not isinstance(microphone_array.decay, InverseSquare):
            return microphone_array.response(chart)
        position = microphone_array.surface.place(chart)
        xp = namespace(position)
        polynomial_terms = [xp.sum(position**2, axis=0), *position, xp.ones_like(position[0])]
        return xp.stack(
            [polynomial_terms[i] * polynomial_terms[j] for i in range(len(polynomial_terms)) for j in range(i + 1)]
        )

    def screen(self, features: Float[Array, "N P"]) -> Float[Array, "F P"]:
        """Loss (F, P) of all frames at candidate positions, computed by matrix products.

        With A = I_k g_k and n microphones in use, the loss is n A² − 2 A Σ I_i g_i + Σ I_i² g_i². For the
        inverse-square model, g is quadratic in the position, so the loss is a polynomial of degree four. The polynomial
        is computed as the product of its coefficients and the features.
        """
        xp = namespace(self, features)
        num_used_microphones = xp.sum(self.use, axis=0)
        if not isinstance(self.microphone_array.decay, InverseSquare):
            inverse_response = 1 / features
            loudest_strengths = xp.take(inverse_response, self.loudest, axis=0)
            return (
                num_used_microphones[:, None] * loudest_strengths - 2 * (self.power.T @ inverse_response)
            ) * loudest_strengths + (self.power.T**2) @ inverse_response**2
        decay_model, microphone_positions = self.microphone_array.decay, self.microphone_array.microphones
        constant_term = xp.sum(microphone_positions**2, axis=1) + decay_model.b
        quadratic_term = (
            xp.column_stack([xp.ones(len(microphone_positions)), -2 * microphone_positions, constant_term])
            / decay_model.a[:, None]
        )
        strength_estimates = [self.power * coefficient_column[:, None] for coefficient_column in quadratic_term.T]
        loudest_strengths = [
            xp.take_along_axis(strength_estimate, self.loudest[None], axis=0)[0]
            for strength_estimate in strength_estimates
        ]
        weighted_sums = [xp.sum(strength_estimate, axis=0) for strength_estimate in strength_estimates]
        polynomial_coefficients = []
        for i in range(len(strength_estimates)):
            for j in range(i + 1):
                polynomial_coefficient = (
                    num_used_microphones * loudest_strengths[i] * loudest_strengths[j]
                    - loudest_strengths[i] * weighted_sums[j]
                    - loudest_strengths[j] * weighted_sums[i]
                )
                polynomial_coefficient = polynomial_coefficient + xp.sum(
                    strength_estimates[i] * strength_estimates[j], axis=0
                )
                polynomial_coefficients.append(polynomial_coefficient if i == j else 2 * polynomial_coefficient)
        return xp.stack(polynomial_coefficients, axis=1) @ features

    def covariance(self, chart: Float[Array, "2 F"], strength: Float[Array, " F"]) -> Float[Array, "2 2 F"]:
        """Covariance (2, 2, F) of the position u of the minimum, from the variances of the intensities: Σ_i
        (∂u/∂I_i)(∂u/∂I_i)ᵀ var I_i.

        The implicit function theorem gives the derivative of u, ∂u/∂I = −H⁻¹ ∂²L/∂u∂I, where H is the Hessian of the
        loss L. Second derivatives are approximated for small differences I_k g_k − I_i g_i.
        """
        strength_estimates, derivatives = slopes(lambda u: 1 / self.microphone_array.response(u), chart)
        xp = namespace(self, strength_estimates)
        estimate_gradients = xp.stack(derivatives) * self.power
        loudest_gradient = xp.take_along_axis(estimate_gradients, self.loudest[None, None], axis=1)
        difference_gradients = xp.where(self.use, loudest_gradient - estimate_gradients, 0.0)
        gauss_newton_matrix = xp.einsum("kmf,lmf->klf", difference_gradients, difference_gradients)
        # Derivative of ½ ∂L/∂u with respect to I_i: −g_i times the gradient of the difference of microphone i. For the
        # loudest microphone k, the derivative is g_k times the sum of these gradients over all microphones.
        is_loudest = xp.arange(strength_estimates.shape[0])[:, None] == self.loudest
        mixed_derivatives = xp.where(
            is_loudest,
            xp.sum(difference_gradients, axis=1, keepdims=True) * strength_estimates,
            -strength_estimates * difference_gradients,
        )
        received_power = strength / strength_estimates
        power_variance = (
            self.microphone_array.noise.variance(received_power) / xp.where(self.scale > 0, self.scale, 1.0) ** 2
        )
        gradient_covariance = xp.einsum(
            "kmf,lmf,mf->klf", mixed_derivatives, mixed_derivatives, xp.where(self.use, power_variance, 0.0)
        )
        inverse_matrix = inverse_small(gauss_newton_matrix)
        return xp.einsum("ijf,jkf,klf->ilf", inverse_matrix, gradient_covariance, inverse_matrix)


# Number of candidate positions along the outline of the skin.
_NUM_OUTLINE_CANDIDATES = 240
# Distance, as a fraction of the skin's size, below which two minima are considered the same.
_MIN_DISTANCE_OF_MINIMA = 0.05
# Number of steps in the second valley before its cost is compared with that of the first valley.
_NUM_TRIAL_STEPS = 8
# Maximum difference of cost for which the minimisation in the second valley continues.
_MAX_COST_DIFFERENCE = 8.0
# Maximum number of steps of a minimisation.
_MAX_MINIMISATION_STEPS = 30
# Tolerance of the minimisation: predicted decrease of the cost in the next step, relative to 1 + |cost|.
_MINIMISATION_TOLERANCE = 1e-12


def find_minima(objective, first_start, second_start, has_second_start):
    """Minimise the objective of each frame from two starting positions, `first_start` and `second_start` (2, F).

    `has_second_start`: mask of the frames for which the second start is tried, or None for no frame; a second start is
    abandoned if its cost is still clearly higher after a few steps. Returns the unknowns (n, F) at the minimum; the
    cost on the outline minus the cost of the minimum beyond the outline; the difference of cost between the two minima;
    whether the minimisation converged; and the start and end (2, 2, F) of the side of the outline to which the position
    was moved, NaN for positions inside.
    """
    surface = objective.microphone_array.surface
    first_minimum = _minimise_in_plane(objective, objective.start(first_start), None)
    unknowns, has_converged = first_minimum.x, first_minimum.converged
    xp = namespace(objective, unknowns)
    lowest_value = xp.where(xp.isfinite(first_minimum.value), first_minimum.value, xp.inf)
    is_inside_outline = surface.outline.contains(unknowns[:2].T)
    second_minimum_excess, lowest_cost = xp.full(lowest_value.shape, xp.inf), lowest_value
    if has_second_start is not None:
        # After a few steps, the minimisation continues only in promising second valleys.
        trial_minimum = _minimise_in_plane(
            objective, objective.start(second_start), ~has_second_start, max_steps=_NUM_TRIAL_STEPS
        )
        has_second_start = has_second_start & (trial_minimum.value < lowest_value + _MAX_COST_DIFFERENCE)
        second_minimum = _minimise_in_plane(objective, trial_minimum.x, ~has_second_start)
        second_cost = xp.where(has_second_start & xp.isfinite(second_minimum.value), second_minimum.value, xp.inf)
        is_second_inside = surface.outline.contains(second_minimum.x[:2].T)
        is_distinct_minimum = xp.linalg.norm(
            second_minimum.x[:2] - unknowns[:2], axis=0
        ) > _MIN_DISTANCE_OF_MINIMA * longer_side(surface)
        second_minimum_excess = xp.where(
            is_distinct_minimum & has_second_start & is_inside_outline & is_second_inside,
            xp.abs(second_cost - lowest_value),
            xp.inf,
        )
        lowest_cost = xp.minimum(lowest_value, second_cost)
        # If one of the two minima is outside the outline, the minimum inside is selected. A position on the outline may
        # still have a lower cost.
        is_second_better = xp.where(
            is_second_inside == is_inside_outline,
            second_cost < lowest_value,
            is_second_inside & xp.isfinite(second_cost),
        )
        unknowns = xp.where(is_second_better, second_minimum.x, unknowns)
        has_converged = xp.where(is_second_better, second_minimum.converged, has_converged)
        lowest_value, is_inside_outline = (
            xp.where(is_second_better, second_cost, lowest_value),
            xp.where(is_second_better, is_second_inside, is_inside_outline),
        )
    # Minima outside the outline are replaced by the best position on the outline. A minimum inside is also compared
    # with the best position on the outline, if the other minimum is outside and has a lower cost.
    needs_outline = xp.isfinite(lowest_value) & (~is_inside_outline | (lowest_cost < lowest_value))
    undefined_sides = xp.full((2, 2, lowest_value.size), xp.nan)

    def move_to_outline(_):
        outline_minimum, outline_side = _minimise_on_outline(objective, ~needs_outline)
        is_outline_better = needs_outline & (~is_inside_outline | (outline_minimum.value < lowest_value))
        return (
            xp.where(is_outline_better, outline_minimum.x, unknowns),
            xp.where(
                needs_outline, xp.where(is_outline_better, outline_minimum.value, lowest_value) - lowest_cost, 0.0
            ),
            xp.where(is_outline_better, outline_minimum.converged, has_converged),
            xp.where(is_outline_better, outline_side, undefined_sides),
        )

    def keep_minimum_inside(_):
        return unknowns, xp.zeros_like(lowest_value), has_converged, undefined_sides

    needs_outline_search = xp.any(needs_outline)
    final_minima = (
        (move_to_outline(None) if needs_outline_search else keep_minimum_inside(None))
        if xp is np
        else jax.lax.cond(needs_outline_search, move_to_outline, keep_minimum_inside, None)
    )
    unknowns, excess_cost, has_converged, outline_side = final_minima
    return unknowns, excess_cost, second_minimum_excess, has_converged, outline_side


def _minimise_in_plane(objective, initial_unknowns, is_skipped_frame, *, max_steps: int | None = None) -> Minimum:
    """Minimise the objective within the bounding box of the outline, extended by its longer side in all directions. A
    step is at most a quarter of the longer side, and a factor of ten in strength.

    `max_steps`: maximum number of steps, all with the approximate Hessian. By default, the last steps use the exact
    Hessian of the objective.
    """
    surface = objective.microphone_array.surface
    lower_corner, upper_corner = bounding_box(surface)
    xp = namespace(objective, initial_unknowns)
    infinite_bounds = xp.full(initial_unknowns.shape[0] - 2, xp.inf)
    skin_size = longer_side(surface)

    def expand_frames(frames):
        return type(objective)(*frames, objective.microphone_array)

    return minimise_small(
        lambda x, frames: expand_frames(frames).expand(x),
        initial_unknowns,
        objective.frames,
        finish=None if max_steps is not None else lambda x, frames: _expand_exactly(expand_frames(frames), x),
        max_steps=max_steps or _MAX_MINIMISATION_STEPS,
        lower=xp.concatenate([lower_corner - skin_size, -infinite_bounds])[:, None],
        upper=xp.concatenate([upper_corner + skin_size, infinite_bounds])[:, None],
        largest_step=xp.concatenate([xp.full(2, skin_size / 4), xp.full_like(infinite_bounds, 2.3)])[:, None],
        tolerance=_MINIMISATION_TOLERANCE,
        skip=is_skipped_frame,
    )


def _expand_exactly(objective, x) -> tuple[Array, Array, Array]:
    """Value, gradient and Hessian of the objective at the unknowns `x`. The Hessian is exact where the exact Hessian is
    positive definite, and approximate elsewhere. With the exact Hessian, few steps are needed near a minimum even if
    the misfit is large."""
    objective_value, objective_gradient, approximate_hessian = objective.expand(x)
    exact_hessian = hessian_small(objective.cost, x)
    return (
        objective_value,
        objective_gradient,
        namespace(exact_hessian).where(definite_small(exact_hessian), exact_hessian, approximate_hessian),
    )


def _minimise_on_outline(objective, is_skipped_frame) -> tuple[Minimum, Array]:
    """Find the best position on the outline: the best of many candidates, refined along its side of the outline. Frames
    in the mask `is_skipped_frame` (F,) are left out. Also returns the start and end of the side (2, 2, F).
    """
    side_starts, side_stops = outline_sides(objective.microphone_array.surface)
    xp = namespace(objective, side_starts)
    side_lengths = xp.linalg.norm(side_stops - side_starts, axis=0)
    # Candidate positions are equally spaced along the outline. Each candidate is specified by a side and a fraction of
    # the side's length.
    arc_lengths = xp.concatenate([xp.zeros(1), xp.cumsum(side_lengths)])
    candidate_arc_lengths = arc_lengths[-1] * (xp.arange(_NUM_OUTLINE_CANDIDATES) + 0.5) / _NUM_OUTLINE_CANDIDATES
    side_indices = xp.clip(
        xp.searchsorted(arc_lengths, candidate_arc_lengths, side="right") - 1, 0, side_lengths.size - 1
    )
    side_fractions = (candidate_arc_lengths - arc_lengths[side_indices]) / side_lengths[side_indices]
    candidate_positions = side_starts[:, side_indices] + side_fractions * (side_stops - side_starts)[:, side_indices]
    candidate_costs = objective.screen(type(objective).features(objective.microphone_array, candidate_positions))
    best_candidates = xp.argmin(xp.where(xp.isnan(candidate_costs), xp.inf, candidate_costs), axis=1)
    side_origins, side_directions = (
        side_starts[:, side_indices[best_candidates]],
        (side_stops - side_starts)[:, side_indices[best_candidates]],
    )
    log_strengths = objective.start(candidate_positions[:, best_candidates])[2:]

    def side_to_plane_unknowns(side_unknowns, side_origins, side_directions):
        return xp.concatenate([side_origins + side_unknowns[0] * side_directions, side_unknowns[1:]])

    def expand_on_side(side_unknowns, side_data):
        side_origins, side_directions, frames = side_data
        frame_objective = type(objective)(*frames, objective.microphone_array)
        objective_value, objective_gradient, objective_matrix = frame_objective.expand(
            side_to_plane_unknowns(side_unknowns, side_origins, side_directions)
        )
        projected_gradient = xp.concatenate(
            [xp.sum(side_directions * objective_gradient[:2], axis=0)[None], objective_gradient[2:]]
        )
        projected_rows = xp.concatenate(
            [xp.einsum("kf,klf->lf", side_directions, objective_matrix[:2])[None], objective_matrix[2:]]
        )
        projected_matrix = xp.concatenate(
            [xp.einsum("klf,lf->kf", projected_rows[:, :2], side_directions)[:, None], projected_rows[:, 2:]], axis=1
        )
        return objective_value, projected_gradient, projected_matrix

    num_strengths = log_strengths.shape[0]
    side_minimum = minimise_small(
        expand_on_side,
        xp.concatenate([side_fractions[best_candidates][None], log_strengths]),
        (side_origins, side_directions, objective.frames),
        lower=xp.array([0.0] + num_strengths * [-xp.inf])[:, None],
        upper=xp.array([1.0] + num_strengths * [xp.inf])[:, None],
        largest_step=xp.array([0.5] + num_strengths * [2.3])[:, None],
        tolerance=_MINIMISATION_TOLERANCE,
        skip=is_skipped_frame,
    )
    side_ends = side_origins + side_directions
    is_in_corner = (side_minimum.x[0] <= 0) | (side_minimum.x[0] >= 1)
    # A position in a corner of the outline cannot move along a side, so its side is replaced by a side of length zero.
    active_side = xp.stack([side_origins, xp.where(is_in_corner, side_origins, side_ends)])
    return Minimum(
        side_to_plane_unknowns(side_minimum.x, side_origins, side_directions),
        side_minimum.value,
        side_minimum.converged,
        side_minimum.steps,
    ), active_side


def differentiable_minima(objective, unknowns, side, skin_size):
    """Return the unknowns at a minimum, `unknowns`, as a differentiable function of all arrays in `objective`.

    The result is a Newton step x − H⁻¹ ∇cost from the minimum x, with x and the Hessian H held constant. The step is
    zero, and its derivative −H⁻¹ ∂∇cost is the derivative of the minimum by the implicit function theorem. `side`:
    start and end of the side of the outline on which the minimum lies; NaN inside the outline. `skin_size`: size of the
    skin in metres.
    """
    constant_minimum, xp = undifferentiated(unknowns), namespace(objective, unknowns)

    def finite_cost(constant_minimum):
        objective_cost = objective.cost(constant_minimum)
        return xp.where(xp.isfinite(objective_cost), objective_cost, 0.0)

    hessian = hessian_small(undifferentiated(objective).cost, constant_minimum)
    objective_gradient = gradient_small(finite_cost, constant_minimum)
    # Positions on the outline can move only along their side, so the step is projected onto the side.
    is_on_outline = ~xp.isnan(side[0, 0])
    side_direction = xp.where(is_on_outline, side[1] - side[0], 0.0)
    side_length = xp.linalg.norm(xp.where(side_direction == 0, 1e-300, side_direction), axis=0)
    side_direction = xp.where(side_length > 1e-12 * skin_size, side_direction / side_length, 0.0)
    tangent_projector = xp.where(is_on_outline, side_direction[:, None] * side_direction[None], xp.eye(2)[:, :, None])
    unknowns_projector = set_at(
        xp.zeros_like(hessian) + xp.eye(len(constant_minimum))[:, :, None], np.s_[:2, :2], tangent_projector
    )
    objective_gradient = xp.einsum("klf,lf->kf", unknowns_projector, objective_gradient)
    projected_hessian = xp.einsum("klf,lmf,mnf->knf", unknowns_projector, hessian, unknowns_projector)
    hessian_trace = xp.maximum(xp.einsum("kkf->f", projected_hessian), 1e-300)
    hessian = projected_hessian + (xp.eye(len(constant_minimum))[:, :, None] - unknowns_projector) * hessian_trace
    newton_step = solve_small(hessian, objective_gradient)
    is_small_step = xp.all(xp.isfinite(newton_step), axis=0) & (
        xp.max(xp.abs(newton_step[:2]), axis=0) < 1e-3 * skin_size
    )
    return constant_minimum - xp.where(is_small_step, newton_step, 0.0)
