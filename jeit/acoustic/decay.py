"""Decay models: the intensity received by each microphone as a function of its distance from the source.

A source of strength I₀ at distance r is received with intensity I₀ f_i(r). Every model gives log f_i. The fit is over
the logarithms of the parameters, which keeps them positive.
"""

from __future__ import annotations

import abc
import math
from typing import ClassVar, Self

import equinox as eqx
from jaxtyping import Array, Float

from jeit.acoustic.noise import column
from jeit.arguments import check_name
from jeit_solvers.engines import host, namespace

# Metres²: r = √r² has no derivative at r = 0; a hundredth of a micrometre rounds off the tip.
_TIP = 1e-16


class AbstractDecay(eqx.Module):
    """Base class of decay models: responses f_i of M microphones. A new model is one subclass."""

    name: ClassVar[str]
    parameters: ClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def log_response(self, squared_distance: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """log f_i at squared distances r² (m²) of each microphone."""

    @abc.abstractmethod
    def response(self, squared_distance: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Response f_i at squared distances r² (m²)."""

    @property
    @abc.abstractmethod
    def gain(self) -> Float[Array, " M"]:
        """f_i(0), the response to a source at the microphone."""

    @abc.abstractmethod
    def logarithms(self) -> Float[Array, "K M"]:
        """Logarithms of the parameters (SI units), in the order of `parameters`; the first scales the response."""

    @classmethod
    @abc.abstractmethod
    def from_logarithms(cls, values: Float[Array, "K M"]) -> Self:
        """The model whose parameters have these logarithms."""

    @classmethod
    @abc.abstractmethod
    def start(cls, spacing: float, num_microphones: int) -> Self:
        """Initial guess with gain 1 and a range of about `spacing` (m)."""

    @classmethod
    @abc.abstractmethod
    def bounds(cls, extent: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper bounds of the logarithms for an array `extent` (m) across."""


class InverseSquare(AbstractDecay):
    """f = a / (r² + b): a (M,) and b (M,) in m², b > 0 (Park 2022, text S2)."""

    a: Float[Array, " M"]
    b: Float[Array, " M"]
    name: ClassVar[str] = "inverse-square"
    parameters: ClassVar[tuple[str, ...]] = ("a", "b")

    def log_response(self, squared_distance):
        """log a − log(r² + b)."""
        log = namespace(self, squared_distance).log
        return column(log(self.a), squared_distance) - log(squared_distance + column(self.b, squared_distance))

    def response(self, squared_distance):
        """a / (r² + b)."""
        return column(self.a, squared_distance) / (squared_distance + column(self.b, squared_distance))

    @property
    def gain(self):
        """a / b."""
        return self.a / self.b

    def logarithms(self):
        """log a, log b."""
        return _logarithms(self.a, self.b)

    @classmethod
    def from_logarithms(cls, values):
        """From log a, log b."""
        return cls(*namespace(values).exp(values))

    @classmethod
    def start(cls, spacing, num_microphones):
        """a = b = spacing²."""
        same = host.full(num_microphones, float(spacing) ** 2)
        return cls(same, same)

    @classmethod
    def bounds(cls, extent):
        """b from (extent / 1,000)² to (10 extents)²."""
        return (-math.inf, 2 * math.log(1e-3 * extent)), (math.inf, 2 * math.log(10 * extent))


class Exponential(AbstractDecay):
    """f = a exp(−r / l): a (M,) without unit, attenuation length l (M,) in m."""

    a: Float[Array, " M"]
    length: Float[Array, " M"]
    name: ClassVar[str] = "exponential"
    parameters: ClassVar[tuple[str, ...]] = ("a", "length")

    def log_response(self, squared_distance):
        """log a − r / l."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _TIP)
        return column(xp.log(self.a), squared_distance) - distance / column(self.length, squared_distance)

    def response(self, squared_distance):
        """a exp(−r / l)."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _TIP)
        return column(self.a, squared_distance) * xp.exp(-distance / column(self.length, squared_distance))

    @property
    def gain(self):
        """a."""
        return self.a

    def logarithms(self):
        """log a, log l."""
        return _logarithms(self.a, self.length)

    @classmethod
    def from_logarithms(cls, values):
        """From log a, log l."""
        return cls(*namespace(values).exp(values))

    @classmethod
    def start(cls, spacing, num_microphones):
        """a = 1, l = spacing."""
        return cls(host.ones(num_microphones), host.full(num_microphones, float(spacing)))

    @classmethod
    def bounds(cls, extent):
        """l from a thousandth of the extent to 30 extents."""
        return (-math.inf, math.log(1e-3 * extent)), (math.inf, math.log(30 * extent))


class AttenuatedInverseSquare(AbstractDecay):
    """f = a exp(−r / l) / (r² + b): spreading and attenuation; a, b (M,) in m², l (M,) in m."""

    a: Float[Array, " M"]
    b: Float[Array, " M"]
    length: Float[Array, " M"]
    name: ClassVar[str] = "attenuated"
    parameters: ClassVar[tuple[str, ...]] = ("a", "b", "length")

    def log_response(self, squared_distance):
        """log a − log(r² + b) − r / l."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _TIP)
        spreading = xp.log(squared_distance + column(self.b, squared_distance))
        attenuation = distance / column(self.length, squared_distance)
        return column(xp.log(self.a), squared_distance) - spreading - attenuation

    def response(self, squared_distance):
        """a exp(−r / l) / (r² + b)."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _TIP)
        left = column(self.a, squared_distance) * xp.exp(-distance / column(self.length, squared_distance))
        return left / (squared_distance + column(self.b, squared_distance))

    @property
    def gain(self):
        """a / b."""
        return self.a / self.b

    def logarithms(self):
        """log a, log b, log l."""
        return _logarithms(self.a, self.b, self.length)

    @classmethod
    def from_logarithms(cls, values):
        """From log a, log b, log l."""
        return cls(*namespace(values).exp(values))

    @classmethod
    def start(cls, spacing, num_microphones):
        """a = b = spacing², l = 3 spacings."""
        same = host.full(num_microphones, float(spacing) ** 2)
        return cls(same, same, host.full(num_microphones, 3.0 * spacing))

    @classmethod
    def bounds(cls, extent):
        """As those of the other two."""
        low, high = InverseSquare.bounds(extent), Exponential.bounds(extent)
        return (*low[0], high[0][1]), (*low[1], high[1][1])


def _logarithms(*parameters: Float[Array, " M"]) -> Float[Array, "K M"]:
    xp = namespace(parameters)
    return xp.log(xp.stack(parameters))


DECAYS: dict[str, type[AbstractDecay]] = {
    kind.name: kind for kind in (InverseSquare, Exponential, AttenuatedInverseSquare)
}


def find_decay(name: str | type[AbstractDecay]) -> type[AbstractDecay]:
    """Class of a decay model from its name ("inverse-square", "exponential", "attenuated") or the class itself. Raises
    `ValueError` for an unknown name."""
    if isinstance(name, type) and issubclass(name, AbstractDecay):
        return name
    check_name("decay", name, DECAYS, ", a class like theirs, or 'auto'")
    return DECAYS[str(name)]
