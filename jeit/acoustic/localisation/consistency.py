"""Intensity consistency: at the source, the strengths estimated from all microphones by their distances are equal.

The loss of Park 2022, text S2, with g_i = 1 / f_i and k the loudest microphone:

    L(u) = Σ_{i≠k} (I_k g_k(u) − I_i g_i(u))².

The loss ignores noise: far microphones count as much as near ones, multiplied by the distance. Frames are the last axis
of all arrays here, microphones the first; intensities are relative to the loudest.
"""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from jeit.acoustic.decay import InverseSquare
from jeit.acoustic.microphones import MicrophoneArray
from jeit_solvers import inverse_small, symmetric_small
from jeit_solvers.engines import kept, namespace, slopes


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
