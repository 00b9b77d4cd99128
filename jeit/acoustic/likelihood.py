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

from jeit.acoustic.decay import AbstractDecay
from jeit.acoustic.noise import IntensityNoise
from jeit.acoustic.surface import AbstractSurface
from jeit_solvers import symmetric_few


class Listeners(eqx.Module):
    """All that a source's intensities depend on: microphones (M, d) in metres, surface, decay models, noise."""

    microphones: Float[Array, "M d"]
    surface: AbstractSurface
    decay: AbstractDecay
    noise: IntensityNoise

    def response(self, chart: Float[Array, "2 ..."]) -> Float[Array, "M ..."]:
        """f_i of sources at chart coordinates."""
        place = self.surface.place(chart)
        mine = self.microphones.reshape(self.microphones.shape + (1,) * (place.ndim - 1))
        squares = [(place[k] - mine[:, k]) ** 2 for k in range(place.shape[0])]
        return self.decay.response(sum(squares[1:], squares[0]))

    def expected(self, unknowns: Float[Array, "n F"]) -> tuple[Float[Array, "M F"], Float[Array, "M F"]]:
        """Expected levels m and their variances v."""
        each = [unknowns[k : k + 3] for k in range(0, len(unknowns), 3)]
        sent = [jnp.exp(one[2]) * self.response(one[:2]) for one in each]
        received = sum(sent[1:], sent[0])
        return jnp.log(received + self.noise.floor[:, None]), self.noise.level_variance(received)


class Likelihood(eqx.Module):
    """The cost of frames: `power` and `level` y (M, F), which microphones are in `use` (M, F), and the listeners."""

    power: Float[Array, "M F"]
    level: Float[Array, "M F"]
    use: Bool[Array, "M F"]
    listeners: Listeners

    @classmethod
    def create(cls, power: Float[Array, "M F"], use: Bool[Array, "M F"], listeners: Listeners) -> "Likelihood":
        """Of intensities; what is not used may be anything, NaN included."""
        known = jnp.where(use, power, 1.0)
        return cls(known, listeners.noise.level(known), use, listeners)

    @property
    def frames(self) -> tuple[Array, ...]:
        """All that differs from frame to frame."""
        return self.power, self.level, self.use

    def cost(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Negative log-likelihood, up to a constant."""
        mean, variance = self.listeners.expected(unknowns)
        terms = 0.5 * (self.level - mean) ** 2 / variance + 0.5 * jnp.log(variance)
        return jnp.sum(jnp.where(self.use, terms, 0.0), axis=0)

    def misfit(self, unknowns: Float[Array, "n F"]) -> Float[Array, " F"]:
        """Σ (y − m)² / v: chi-square with as many degrees of freedom as microphones in use less unknowns, where the
        model holds."""
        return jnp.sum(self.residual(unknowns) ** 2, axis=0)

    def residual(self, unknowns: Float[Array, "n F"]) -> Float[Array, "M F"]:
        """(y − m) / √v, and 0 for what is not used."""
        mean, variance = self.listeners.expected(unknowns)
        return jnp.where(self.use, (self.level - mean) / jnp.sqrt(variance), 0.0)

    def expand(self, unknowns: Float[Array, "n F"]) -> tuple[Array, Array, Array]:
        """Cost, its gradient, and Fisher's matrix."""
        (mean, variance), push = jax.linearize(self.listeners.expected, unknowns)
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
        matrix = symmetric_few(
            [
                [jnp.sum(weight * dm * em + 0.5 * used * dv * ev, axis=0) for em, ev in slopes[: k + 1]]
                for k, (dm, dv) in enumerate(slopes)
            ]
        )
        return cost, gradient, matrix

    def start(self, chart: Float[Array, "2 F"]) -> Float[Array, "3 F"]:
        """Unknowns at given places, with the strength that suits them best."""
        response = self.listeners.response(chart)
        return jnp.concatenate([chart, jnp.log(self.strength(response))[None]])

    def strength(self, response: Float[Array, "M F"]) -> Float[Array, " F"]:
        """Of sources at known places, by least squares with weights from the observed power; positive."""
        weight = self._weight()
        fitted = jnp.sum(weight * self.power * response, axis=0) / jnp.sum(weight * response**2, axis=0)
        loudest = jnp.max(jnp.where(self.use, self.power / response, 0.0), axis=0)
        return jnp.maximum(fitted, 1e-6 * loudest)

    @staticmethod
    def features(listeners: Listeners, chart: Float[Array, "2 P"]) -> Float[Array, "M P"]:
        """What `screen` needs of candidate places: their responses f."""
        return listeners.response(chart)

    def screen(self, response: Float[Array, "M P"]) -> Float[Array, "F P"]:
        """What is left unexplained by candidate places of responses f, with weights from the observed power and
        the best strength: ½ (Σ w p² − (Σ w p f)² / Σ w f²). Two matrix products for all frames and places."""
        weight = self._weight()
        seen = weight * self.power
        fitted = jnp.maximum(seen.T @ response, 0.0) ** 2 / (weight.T @ response**2)
        return 0.5 * (jnp.sum(self.power * seen, axis=0)[:, None] - fitted)

    def _weight(self) -> Float[Array, "M F"]:
        return jnp.where(self.use, 1 / self.listeners.noise.variance(jnp.maximum(self.power, 0.0)), 0.0)
