"""Likelihood of source positions given the levels (logarithms of power) of the microphones, and the Cramér-Rao bound.

Microphones are the first axis of all arrays, and frames the last. The unknowns of a frame are, for each source, its
chart coordinates u and the logarithm s of its strength. The powers of several sources add. With the levels y_i, the
expected levels m_i = log(Σ e^s f_i(u) + N_i) and their variances v_i, the negative log-likelihood is

    cost = Σ_i [½ (y_i − m_i)² / v_i + ½ log v_i]

over the microphones in use. The cost is minimised by Fisher scoring. The Fisher matrix is Σ_i [∇m_i ∇m_iᵀ / v_i + ½
∇log v_i ∇log v_iᵀ]; its inverse is the Cramér-Rao bound.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.acoustic.microphones import MicrophoneArray, check_array
from jeit.acoustic.surface import to_three_dimensions
from jeit_solvers import inverse_small, symmetric_small
from jeit_solvers.engines import computed_once, namespace, numpy_or_compiled, slopes
from jeit_solvers.module import Module


class Likelihood(Module):
    """Negative log-likelihood of source positions and strengths in F frames.

    **Fields**: `power`: intensities (M, F) minus the noise floor; `level`: levels y (M, F); `use`: mask (M, F) of the
    intensities used; `microphone_array`: model of the microphone array.
    """

    power: Float[Array, "M F"]
    level: Float[Array, "M F"]
    use: Bool[Array, "M F"]
    microphone_array: MicrophoneArray

    @classmethod
    def create(
        cls, power: Float[Array, "M F"], use: Bool[Array, "M F"], microphone_array: MicrophoneArray
    ) -> "Likelihood":
        """Create the likelihood from intensities `power`. Intensities outside the mask `use` are ignored and may be
        NaN."""
        used_power = namespace(power, use).where(use, power, 1.0)
        return cls(used_power, microphone_array.noise.level(used_power), use, microphone_array)

    @property
    def frames(self) -> tuple[Array, ...]:
        """Fields of the likelihood whose last axis is the frame."""
        return self.power, self.level, self.use

    def cost(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Negative log-likelihood (F,) of each frame, up to a constant."""
        expected_levels, level_variances = self.microphone_array.expected(unknowns)
        xp = namespace(self, expected_levels)
        likelihood_terms = 0.5 * (self.level - expected_levels) ** 2 / level_variances + 0.5 * xp.log(level_variances)
        return xp.sum(xp.where(self.use, likelihood_terms, 0.0), axis=0)

    def misfit(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Misfit Σ (y − m)² / v (F,) between levels y and expected levels m of variance v. If the model is correct, the
        misfit has a chi-square distribution; its degrees of freedom are the number of microphones in use minus the
        number of unknowns."""
        return (self.residual(unknowns) ** 2).sum(axis=0)

    def residual(self, unknowns: Float[Array, "n F"]) -> Float[Array, "M F"]:
        """Standardised residuals (y − m) / √v of the levels y for expected levels m of variance v; 0 where not used."""
        expected_levels, level_variances = self.microphone_array.expected(unknowns)
        xp = namespace(self, expected_levels)
        return xp.where(self.use, (self.level - expected_levels) / xp.sqrt(level_variances), 0.0)

    def expand(self, unknowns: Float[Array, "n F"]) -> tuple[Array, Array, Array]:
        """Negative log-likelihood (F,), its gradient (n, F) with respect to the n unknowns, and the Fisher matrix (n,
        n, F)."""
        (expected_levels, level_variances), level_derivatives = slopes(self.microphone_array.expected, unknowns)
        # `computed_once` makes the compiler compute these arrays once for all sums below. In the sums, `dv` is the
        # derivative of log v.
        expected_levels, level_variances, level_derivatives = computed_once(
            (expected_levels, level_variances, [(dm, dv / level_variances) for dm, dv in level_derivatives])
        )
        xp = namespace(self, expected_levels)
        usage_weights = xp.where(self.use, 1.0, 0.0)
        level_residuals = self.level - expected_levels
        level_weights = usage_weights / level_variances
        weighted_residual = level_residuals * level_weights
        cost = 0.5 * xp.sum(weighted_residual * level_residuals + usage_weights * xp.log(level_variances), axis=0)
        variance_terms = 0.5 * (usage_weights - weighted_residual * level_residuals)
        level_weights, weighted_residual, variance_terms, usage_weights = computed_once(
            (level_weights, weighted_residual, variance_terms, usage_weights)
        )
        cost_gradient = xp.stack(
            [xp.sum(variance_terms * dv - weighted_residual * dm, axis=0) for dm, dv in level_derivatives]
        )
        fisher_matrix = symmetric_small(
            [
                [
                    xp.sum(level_weights * dm * em + 0.5 * usage_weights * dv * ev, axis=0)
                    for em, ev in level_derivatives[: k + 1]
                ]
                for k, (dm, dv) in enumerate(level_derivatives)
            ]
        )
        return cost, cost_gradient, fisher_matrix

    def start(self, chart: Float[Array, "2 F"]) -> Float[Array, "3 F"]:
        """Initial unknowns of a minimisation: chart coordinates, and logarithm of the best-fitting strength at these
        coordinates."""
        response = self.microphone_array.response(chart)
        xp = namespace(response)
        return xp.concatenate([chart, xp.log(self.strength(response))[None]])

    def strength(self, response: Float[Array, "M F"]) -> Float[Array, " F"]:
        """Strength (F,) of sources with the responses f = `response`, by least squares with weights from the observed
        power. The strength is positive."""
        power_weights, xp = self._power_weights(), namespace(self, response)
        fitted_strength = xp.sum(power_weights * self.power * response, axis=0) / xp.sum(
            power_weights * response**2, axis=0
        )
        max_strength = xp.max(xp.where(self.use, self.power / response, 0.0), axis=0)
        return xp.maximum(fitted_strength, 1e-6 * max_strength)

    @staticmethod
    def features(microphone_array: MicrophoneArray, chart: Float[Array, "2 P"]) -> Float[Array, "M P"]:
        """Features of candidate positions for `screen`: the responses f (M, P)."""
        return microphone_array.response(chart)

    def screen(self, response: Float[Array, "M P"]) -> Float[Array, "F P"]:
        """Half the weighted residual sum of squares (F, P) at candidate positions with responses f and the best-fitting
        strength: ½ (Σ w p² − (Σ w p f)² / Σ w f²), with observed powers p and weights w derived from p. This sum
        approximates the cost, and requires two matrix products for all frames and positions."""
        power_weights, xp = self._power_weights(), namespace(self, response)
        weighted_power = power_weights * self.power
        explained_power = xp.maximum(weighted_power.T @ response, 0.0) ** 2 / (power_weights.T @ response**2)
        return 0.5 * (xp.sum(self.power * weighted_power, axis=0)[:, None] - explained_power)

    def _power_weights(self) -> Float[Array, "M F"]:
        xp = namespace(self)
        return xp.where(self.use, 1 / self.microphone_array.noise.variance(xp.maximum(self.power, 0.0)), 0.0)


def cramer_rao(
    microphone_array: MicrophoneArray,
    position: ArrayLike,
    strength: ArrayLike = 1.0,
    *,
    use: ArrayLike | None = None,
) -> Float[Array, "N d d"]:
    """Cramér-Rao bound (N, d, d) in m²: the minimum covariance of unbiased estimates of the positions of sources.

    The bound is the position block of the inverse Fisher matrix of position and logarithm of strength, for the noise
    model of the microphone array; the strength is treated as unknown.

    **Arguments:**

    - `microphone_array`: model of the array, such as that of a `Calibration`.
    - `position`: true positions (N, d) of the sources, metres.
    - `strength`: true strengths of the sources, (N,) or a number, in the unit of intensity.
    - `use`: mask (M,) of the microphones used; by default all.

    Raises `ValueError` if `microphone_array` is not a `MicrophoneArray`.

    **Example:**

    ```python
    covariance = cramer_rao(calibration.microphone_array, [[0.03, 0.02]], strength=10.0)
    print(np.sqrt(np.trace(covariance[0])))  # metres
    ```
    """
    check_array(microphone_array)
    used_microphones = np.ones(len(microphone_array.microphones), bool) if use is None else use
    return _bound_covariance(microphone_array, position, strength, used_microphones)


@numpy_or_compiled
def _bound_covariance(microphone_array: MicrophoneArray, position, strength, used_microphones) -> Float[Array, "N d d"]:
    xp = namespace(microphone_array, position, strength, used_microphones)
    position = xp.asarray(position, float)
    chart_positions = microphone_array.surface.project(position.T)
    num_sources = chart_positions.shape[1]
    unknowns = xp.concatenate(
        [chart_positions, xp.log(xp.broadcast_to(xp.asarray(strength, float), (num_sources,)))[None]]
    )
    is_used_microphone = xp.broadcast_to(
        xp.asarray(used_microphones, bool)[:, None], (len(used_microphones), num_sources)
    )
    # The Fisher matrix does not depend on the measured intensities.
    _, _, fisher_matrix = Likelihood.create(
        xp.ones(is_used_microphone.shape), is_used_microphone, microphone_array
    ).expand(unknowns)
    return to_three_dimensions(microphone_array.surface, chart_positions, inverse_small(fisher_matrix)[:2, :2])[1]
