"""The likelihood of a place given the levels of the microphones, and its Cramér-Rao bound.

Frames are the last axis of all arrays here, microphones the first. The unknowns of a frame are chart coordinates u and
the logarithm of strength, s, of one source after the other; powers of several sources add. With expected levels m_i(u,
s) = log(Σ e^s f_i(u) + N_i) and variances v_i(u, s),

    cost = Σ_i ½ (y_i − m_i)² / v_i + ½ log v_i

over the microphones in use; steps are Fisher scoring, whose matrix Σ ∇m ∇mᵀ / v + ½ ∇log v ∇log vᵀ is the inverse of
the Cramér-Rao bound.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike

from jeit.acoustic.microphones import MicrophoneArray, check_array
from jeit.acoustic.surface import in_space
from jeit_solvers import inverse_small, symmetric_small
from jeit_solvers.engines import either_engine, kept, namespace, slopes


class Likelihood(eqx.Module):
    """Negative log-likelihood of F frames: `power` and `level` y (M, F), the mask `use` (M, F), and the microphones."""

    power: Float[Array, "M F"]
    level: Float[Array, "M F"]
    use: Bool[Array, "M F"]
    microphone_array: MicrophoneArray

    @classmethod
    def create(
        cls, power: Float[Array, "M F"], use: Bool[Array, "M F"], microphone_array: MicrophoneArray
    ) -> "Likelihood":
        """Create the likelihood from intensities; unused values are ignored and may be NaN."""
        known = namespace(power, use).where(use, power, 1.0)
        return cls(known, microphone_array.noise.level(known), use, microphone_array)

    @property
    def frames(self) -> tuple[Array, ...]:
        """The arrays that differ between frames."""
        return self.power, self.level, self.use

    def cost(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Negative log-likelihood, up to a constant."""
        mean, variance = self.microphone_array.expected(unknowns)
        xp = namespace(self, mean)
        terms = 0.5 * (self.level - mean) ** 2 / variance + 0.5 * xp.log(variance)
        return xp.sum(xp.where(self.use, terms, 0.0), axis=0)

    def misfit(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Misfit Σ (y − m)² / v. Where the model holds it is chi-square distributed; its degrees of freedom are the
        microphones in use minus the unknowns."""
        return (self.residual(unknowns) ** 2).sum(axis=0)

    def residual(self, unknowns: Float[Array, "n F"]) -> Float[Array, "M F"]:
        """Residuals (y − m) / √v; 0 where not used."""
        mean, variance = self.microphone_array.expected(unknowns)
        xp = namespace(self, mean)
        return xp.where(self.use, (self.level - mean) / xp.sqrt(variance), 0.0)

    def expand(self, unknowns: Float[Array, "n F"]) -> tuple[Array, Array, Array]:
        """Cost, gradient, and Fisher matrix."""
        (mean, variance), along = slopes(self.microphone_array.expected, unknowns)
        # Computed once: all sums below use the logarithms.
        mean, variance, along = kept((mean, variance, [(dm, dv / variance) for dm, dv in along]))
        xp = namespace(self, mean)
        used = xp.where(self.use, 1.0, 0.0)
        off = self.level - mean
        weight = used / variance
        scaled = off * weight
        cost = 0.5 * xp.sum(scaled * off + used * xp.log(variance), axis=0)
        excess = 0.5 * (used - scaled * off)
        weight, scaled, excess, used = kept((weight, scaled, excess, used))
        gradient = xp.stack([xp.sum(excess * dv - scaled * dm, axis=0) for dm, dv in along])
        matrix = symmetric_small(
            [
                [xp.sum(weight * dm * em + 0.5 * used * dv * ev, axis=0) for em, ev in along[: k + 1]]
                for k, (dm, dv) in enumerate(along)
            ]
        )
        return cost, gradient, matrix

    def start(self, chart: Float[Array, "2 F"]) -> Float[Array, "3 F"]:
        """Initial unknowns at given positions, with the best-fitting strength."""
        response = self.microphone_array.response(chart)
        xp = namespace(response)
        return xp.concatenate([chart, xp.log(self.strength(response))[None]])

    def strength(self, response: Float[Array, "M F"]) -> Float[Array, " F"]:
        """Strength of sources at known positions, by least squares weighted with the observed power; positive."""
        weight, xp = self._weight(), namespace(self, response)
        fitted = xp.sum(weight * self.power * response, axis=0) / xp.sum(weight * response**2, axis=0)
        loudest = xp.max(xp.where(self.use, self.power / response, 0.0), axis=0)
        return xp.maximum(fitted, 1e-6 * loudest)

    @staticmethod
    def features(microphone_array: MicrophoneArray, chart: Float[Array, "2 P"]) -> Float[Array, "M P"]:
        """Features of candidate positions for `screen`: their responses f."""
        return microphone_array.response(chart)

    def screen(self, response: Float[Array, "M P"]) -> Float[Array, "F P"]:
        """Weighted residual sum of squares at candidate positions with responses f and the best strength, with weights
        from the observed power: ½ (Σ w p² − (Σ w p f)² / Σ w f²). Two matrix products for all frames and positions."""
        weight, xp = self._weight(), namespace(self, response)
        seen = weight * self.power
        fitted = xp.maximum(seen.T @ response, 0.0) ** 2 / (weight.T @ response**2)
        return 0.5 * (xp.sum(self.power * seen, axis=0)[:, None] - fitted)

    def _weight(self) -> Float[Array, "M F"]:
        xp = namespace(self)
        return xp.where(self.use, 1 / self.microphone_array.noise.variance(xp.maximum(self.power, 0.0)), 0.0)


def cramer_rao(
    microphone_array: MicrophoneArray,
    position: ArrayLike,
    strength: ArrayLike = 1.0,
    *,
    use: ArrayLike | None = None,
) -> Float[Array, "N d d"]:
    """Cramér-Rao bound (N, d, d), m², of the positions of sources at `position` (N, d), metres, with `strength` (N,) or
    one for all, which the localiser does not know.

    The inverse of the Fisher matrix of position and log strength, under the noise model of `microphone_array`. `use`:
    (M,) mask of the microphones used, all unless given. Raises `ValueError` for what is no `MicrophoneArray`.
    """
    check_array(microphone_array)
    present = np.ones(len(microphone_array.microphones), bool) if use is None else use
    return _least_covariance(microphone_array, position, strength, present)


@either_engine
def _least_covariance(microphone_array: MicrophoneArray, position, strength, present) -> Float[Array, "N d d"]:
    xp = namespace(microphone_array, position, strength, present)
    position = xp.asarray(position, float)
    chart = microphone_array.surface.project(position.T)
    number = chart.shape[1]
    unknowns = xp.concatenate([chart, xp.log(xp.broadcast_to(xp.asarray(strength, float), (number,)))[None]])
    there = xp.broadcast_to(xp.asarray(present, bool)[:, None], (len(present), number))
    # The Fisher matrix does not depend on the measured values.
    _, _, matrix = Likelihood.create(xp.ones(there.shape), there, microphone_array).expand(unknowns)
    return in_space(microphone_array.surface, chart, inverse_small(matrix)[:2, :2])[1]
