"""Maximum likelihood: where a source most probably is, given what every microphone receives and how well it is known.

Frames are the last axis of all arrays here, microphones the first. The unknowns of a frame are chart coordinates u
and the logarithm of strength, s, of one source after the other; what several send adds up. With expected levels
m_i(u, s) = log(Σ e^s f_i(u) + N_i) and variances v_i(u, s),

    cost = Σ_i ½ (y_i − m_i)² / v_i + ½ log v_i

over the microphones in use; steps are Fisher's scoring, whose matrix Σ ∇m ∇mᵀ / v + ½ ∇log v ∇log vᵀ is the inverse of
the Cramér-Rao bound.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jeit.acoustic.microphones import MicrophoneArray
from jeit_solvers import symmetric_small


class Likelihood(eqx.Module):
    """The cost of frames: `power` and `level` y (M, F), which microphones are in `use` (M, F),
    and the microphones."""

    power: Float[Array, "M F"]
    level: Float[Array, "M F"]
    use: Bool[Array, "M F"]
    microphone_array: MicrophoneArray

    @classmethod
    def create(
        cls, power: Float[Array, "M F"], use: Bool[Array, "M F"], microphone_array: MicrophoneArray
    ) -> "Likelihood":
        """Of intensities; what is not used may be anything, NaN included."""
        known = jnp.where(use, power, 1.0)
        return cls(known, microphone_array.noise.level(known), use, microphone_array)

    @property
    def frames(self) -> tuple[Array, ...]:
        """All that differs from frame to frame."""
        return self.power, self.level, self.use

    def cost(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Negative log-likelihood, up to a constant."""
        mean, variance = self.microphone_array.expected(unknowns)
        terms = 0.5 * (self.level - mean) ** 2 / variance + 0.5 * jnp.log(variance)
        return jnp.sum(jnp.where(self.use, terms, 0.0), axis=0)

    def misfit(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Σ (y − m)² / v: chi-square with as many degrees of freedom as microphones in use less unknowns, where the
        model holds."""
        return jnp.sum(self.residual(unknowns) ** 2, axis=0)

    def residual(self, unknowns: Float[Array, "n F"]) -> Float[Array, "M F"]:
        """(y − m) / √v, and 0 for what is not used."""
        mean, variance = self.microphone_array.expected(unknowns)
        return jnp.where(self.use, (self.level - mean) / jnp.sqrt(variance), 0.0)

    def expand(self, unknowns: Float[Array, "n F"]) -> tuple[Array, Array, Array]:
        """Cost, its gradient, and Fisher's matrix."""
        (mean, variance), push = jax.linearize(self.microphone_array.expected, unknowns)
        basis = jnp.eye(len(unknowns))[:, :, None] * jnp.ones_like(unknowns)
        slopes = [(dm, dv / variance) for dm, dv in (push(direction) for direction in basis)]
        # Kept, or XLA would work the logarithms out anew for every one of the sums below.
        mean, variance, slopes = jax.lax.optimization_barrier((mean, variance, slopes))
        used = jnp.where(self.use, 1.0, 0.0)
        off = self.level - mean
        weight = used / variance
        scaled = off * weight
        cost = 0.5 * jnp.sum(scaled * off + used * jnp.log(variance), axis=0)
        excess = 0.5 * (used - scaled * off)
        weight, scaled, excess, used = jax.lax.optimization_barrier((weight, scaled, excess, used))
        gradient = jnp.stack([jnp.sum(excess * dv - scaled * dm, axis=0) for dm, dv in slopes])
        matrix = symmetric_small(
            [
                [jnp.sum(weight * dm * em + 0.5 * used * dv * ev, axis=0) for em, ev in slopes[: k + 1]]
                for k, (dm, dv) in enumerate(slopes)
            ]
        )
        return cost, gradient, matrix

    def start(self, chart: Float[Array, "2 F"]) -> Float[Array, "3 F"]:
        """Unknowns at given places, with the strength that suits them best."""
        response = self.microphone_array.response(chart)
        return jnp.concatenate([chart, jnp.log(self.strength(response))[None]])

    def strength(self, response: Float[Array, "M F"]) -> Float[Array, " F"]:
        """Of sources at known places, by least squares with weights from the observed power; positive."""
        weight = self._weight()
        fitted = jnp.sum(weight * self.power * response, axis=0) / jnp.sum(weight * response**2, axis=0)
        loudest = jnp.max(jnp.where(self.use, self.power / response, 0.0), axis=0)
        return jnp.maximum(fitted, 1e-6 * loudest)

    @staticmethod
    def features(microphone_array: MicrophoneArray, chart: Float[Array, "2 P"]) -> Float[Array, "M P"]:
        """What `screen` needs of candidate places: their responses f."""
        return microphone_array.response(chart)

    def screen(self, response: Float[Array, "M P"]) -> Float[Array, "F P"]:
        """What is left unexplained by candidate places of responses f, with weights from the observed power and
        the best strength: ½ (Σ w p² − (Σ w p f)² / Σ w f²). Two matrix products for all frames and places."""
        weight = self._weight()
        seen = weight * self.power
        fitted = jnp.maximum(seen.T @ response, 0.0) ** 2 / (weight.T @ response**2)
        return 0.5 * (jnp.sum(self.power * seen, axis=0)[:, None] - fitted)

    def _weight(self) -> Float[Array, "M F"]:
        return jnp.where(self.use, 1 / self.microphone_array.noise.variance(jnp.maximum(self.power, 0.0)), 0.0)
