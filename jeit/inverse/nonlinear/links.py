"""Links: the scale on which conductivity is estimated, x for σ = link(x), cell by cell."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from jeit_solvers.engines import has_values, namespace

# Share of the background below which no conductivity is taken where nothing else keeps it from zero.
_LEAST = 1e-6


class AbstractLink(eqx.Module):
    """Base of all links between the estimated quantity x and conductivity σ, increasing and smooth."""

    @abc.abstractmethod
    def conductivity(self, estimate: Float[Array, " m"]) -> Float[Array, " m"]:
        """σ(x), S/m (2-D: S)."""

    @abc.abstractmethod
    def slope(self, estimate: Float[Array, " m"]) -> Float[Array, " m"]:
        """dσ/dx at x."""

    @abc.abstractmethod
    def estimate(self, conductivity: Float[Array, " m"]) -> Float[Array, " m"]:
        """x(σ), the inverse of `conductivity`. Raises `ValueError` for conductivities that no x gives.

        σ in S/m (2-D: S).
        """

    def ends(self, lower: float, upper: float, reference: Float[Array, " m"]) -> tuple[float, float]:
        """The estimates that two bounds on σ stand for, in an image about `reference`. Raises `ValueError` for a link
        that takes none."""
        raise ValueError(f"bounds: link {type(self).__name__} takes none; take Log() or Linear().")


class Linear(AbstractLink):
    """σ = x. Nothing keeps conductivity positive; a step that leads below zero is refused and shortened."""

    def conductivity(self, estimate):
        """x."""
        return estimate

    def slope(self, estimate):
        """1."""
        return namespace(estimate).ones_like(estimate)

    def estimate(self, conductivity):
        """σ. In S/m (2-D: S)."""
        return conductivity

    def ends(self, lower, upper, reference):
        """The bounds themselves, and no less than a millionth of the background."""
        return namespace(lower, reference).maximum(lower, _LEAST * reference.mean()), upper


class Log(AbstractLink):
    """σ = exp(x): always positive, and a ratio of conductivities counts alike on either side of one."""

    def conductivity(self, estimate):
        """exp(x)."""
        return namespace(estimate).exp(estimate)

    def slope(self, estimate):
        """exp(x)."""
        return namespace(estimate).exp(estimate)

    def estimate(self, conductivity):
        """log(σ). σ in S/m (2-D: S). Raises `ValueError` unless it is positive."""
        _check_inside(conductivity, 0, np.inf)
        return namespace(conductivity).log(conductivity)

    def ends(self, lower, upper, reference):
        """Their logarithms: zero is no bound at all."""
        with np.errstate(divide="ignore"):
            return namespace(lower).log(lower), namespace(upper).log(upper)


class Bounded(AbstractLink):
    """σ = lower + (upper - lower) / (1 + exp(-x)): strictly between `lower` and `upper`, S/m (2-D: S).

    Raises `ValueError` unless 0 ≤ lower < upper, finite.
    """

    lower: float
    upper: float

    def __check_init__(self):
        if has_values(self.lower) and not 0 <= self.lower < self.upper < np.inf:
            raise ValueError(f"Bounded: give 0 ≤ lower < upper, finite; they are {self.lower} and {self.upper}.")

    def conductivity(self, estimate):
        """The logistic function between the bounds."""
        return self.lower + (self.upper - self.lower) * _logistic(estimate)

    def slope(self, estimate):
        """Its derivative, largest half way between the bounds."""
        share = _logistic(estimate)
        return (self.upper - self.lower) * share * (1 - share)

    def estimate(self, conductivity):
        """The logit of σ's place between the bounds. Raises `ValueError` outside them."""
        _check_inside(conductivity, self.lower, self.upper)
        share = (conductivity - self.lower) / (self.upper - self.lower)
        xp = namespace(share)
        return xp.log(share) - xp.log1p(-share)

    def ends(self, lower, upper, reference):
        """Not beside its own. Raises `ValueError`."""
        raise ValueError("bounds: the link is bounded already; give bounds or link=Bounded(lower, upper), not both.")


def _logistic(estimate):
    return scipy.special.expit(estimate) if isinstance(estimate, np.ndarray) else jax.nn.sigmoid(estimate)


def _check_inside(conductivity, lower, upper) -> None:
    if not has_values(conductivity, lower, upper):
        return
    values = np.asarray(conductivity)
    if not ((values > lower) & (values < upper)).all():
        raise ValueError(
            f"conductivity must lie between {lower:g} and {upper:g}; it goes from {values.min():.3g} to "
            f"{values.max():.3g}."
        )
