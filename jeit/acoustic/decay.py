"""Decay models: the intensity received by each microphone as a function of its distance from the source.

Microphone i receives a source of strength I₀ at distance r with the intensity I₀ f_i(r). The models compute the
response f_i and its logarithm. Fits use the logarithms of the models' parameters, which keeps the parameters positive.
"""

from __future__ import annotations

import abc
import math
from typing import ClassVar, Self

from jaxtyping import Array, Float

from jeit.arguments import check_name
from jeit_solvers.engines import host, namespace
from jeit_solvers.module import Module

# Constant in m² added to r², the square of a hundredth of a micrometre, since r = √r² has no derivative at r = 0.
_DISTANCE_SMOOTHING = 1e-16


class AbstractDecay(Module):
    """Base class of decay models, which compute the responses f_i of M microphones. A new decay model is a subclass."""

    name: ClassVar[str]
    parameters: ClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def log_response(self, squared_distance: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Logarithm of the response f_i of each microphone at squared distances r² in m²."""

    @abc.abstractmethod
    def response(self, squared_distance: Float[Array, "M ..."]) -> Float[Array, "M ..."]:
        """Response f_i of each microphone at squared distances r² in m²."""

    @property
    @abc.abstractmethod
    def gain(self) -> Float[Array, " M"]:
        """Response f_i(0) of each microphone to a source at distance 0."""

    @abc.abstractmethod
    def logarithms(self) -> Float[Array, "K M"]:
        """Logarithms (K, M) of the parameters in SI units, in the order of `parameters`. The response is proportional
        to the first parameter."""

    @classmethod
    @abc.abstractmethod
    def from_logarithms(cls, values: Float[Array, "K M"]) -> Self:
        """Create the decay model from the logarithms (K, M) of its K parameters in SI units."""

    @classmethod
    @abc.abstractmethod
    def start(cls, spacing: float, num_microphones: int) -> Self:
        """Create the initial decay model of a fit, with gain 1 and a decay over about `spacing` metres."""

    @classmethod
    @abc.abstractmethod
    def bounds(cls, extent: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper bounds of the logarithms of the parameters, for a microphone array of size `extent` in
        metres."""


class InverseSquare(AbstractDecay):
    """Inverse-square decay model f = a / (r² + b), with a (M,) and b (M,) in m² and b > 0 (Park 2022, text S2)."""

    a: Float[Array, " M"]
    b: Float[Array, " M"]
    name: ClassVar[str] = "inverse-square"
    parameters: ClassVar[tuple[str, ...]] = ("a", "b")

    def log_response(self, squared_distance):
        """Logarithm of the response: log a − log(r² + b)."""
        logarithm = namespace(self, squared_distance).log
        return column(logarithm(self.a), squared_distance) - logarithm(
            squared_distance + column(self.b, squared_distance)
        )

    def response(self, squared_distance):
        """Response a / (r² + b)."""
        return column(self.a, squared_distance) / (squared_distance + column(self.b, squared_distance))

    @property
    def gain(self):
        """Response a / b at distance 0."""
        return self.a / self.b

    def logarithms(self):
        """Logarithms of the parameters: log a, log b."""
        return _stack_logarithms(self.a, self.b)

    @classmethod
    def from_logarithms(cls, values):
        """Create the model from log a and log b."""
        return cls(*namespace(values).exp(values))

    @classmethod
    def start(cls, spacing, num_microphones):
        """Initial model with a = b = spacing²."""
        squared_spacing = host.full(num_microphones, float(spacing) ** 2)
        return cls(squared_spacing, squared_spacing)

    @classmethod
    def bounds(cls, extent):
        """Bounds of the logarithms: b is between (extent / 1,000)² and (10 extent)²; a is not bounded."""
        return (-math.inf, 2 * math.log(1e-3 * extent)), (math.inf, 2 * math.log(10 * extent))


class Exponential(AbstractDecay):
    """Exponential decay model f = a exp(−r / l), with dimensionless a (M,) and attenuation length l (M,) in m."""

    a: Float[Array, " M"]
    length: Float[Array, " M"]
    name: ClassVar[str] = "exponential"
    parameters: ClassVar[tuple[str, ...]] = ("a", "length")

    def log_response(self, squared_distance):
        """Logarithm of the response: log a − r / l."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _DISTANCE_SMOOTHING)
        return column(xp.log(self.a), squared_distance) - distance / column(self.length, squared_distance)

    def response(self, squared_distance):
        """Response a exp(−r / l)."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _DISTANCE_SMOOTHING)
        return column(self.a, squared_distance) * xp.exp(-distance / column(self.length, squared_distance))

    @property
    def gain(self):
        """Response a at distance 0."""
        return self.a

    def logarithms(self):
        """Logarithms of the parameters: log a, log l."""
        return _stack_logarithms(self.a, self.length)

    @classmethod
    def from_logarithms(cls, values):
        """Create the model from log a and log l."""
        return cls(*namespace(values).exp(values))

    @classmethod
    def start(cls, spacing, num_microphones):
        """Initial model with a = 1 and l = spacing."""
        return cls(host.ones(num_microphones), host.full(num_microphones, float(spacing)))

    @classmethod
    def bounds(cls, extent):
        """Bounds of the logarithms: l is between extent / 1,000 and 30 extent; a is not bounded."""
        return (-math.inf, math.log(1e-3 * extent)), (math.inf, math.log(30 * extent))


class AttenuatedInverseSquare(AbstractDecay):
    """Decay model with spreading and attenuation, f = a exp(−r / l) / (r² + b), with a (M,) and b (M,) in m² and l (M,)
    in m."""

    a: Float[Array, " M"]
    b: Float[Array, " M"]
    length: Float[Array, " M"]
    name: ClassVar[str] = "attenuated"
    parameters: ClassVar[tuple[str, ...]] = ("a", "b", "length")

    def log_response(self, squared_distance):
        """Logarithm of the response: log a − log(r² + b) − r / l."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _DISTANCE_SMOOTHING)
        spreading = xp.log(squared_distance + column(self.b, squared_distance))
        attenuation = distance / column(self.length, squared_distance)
        return column(xp.log(self.a), squared_distance) - spreading - attenuation

    def response(self, squared_distance):
        """Response a exp(−r / l) / (r² + b)."""
        xp = namespace(self, squared_distance)
        distance = xp.sqrt(squared_distance + _DISTANCE_SMOOTHING)
        attenuated_gain = column(self.a, squared_distance) * xp.exp(-distance / column(self.length, squared_distance))
        return attenuated_gain / (squared_distance + column(self.b, squared_distance))

    @property
    def gain(self):
        """Response a / b at distance 0."""
        return self.a / self.b

    def logarithms(self):
        """Logarithms of the parameters: log a, log b, log l."""
        return _stack_logarithms(self.a, self.b, self.length)

    @classmethod
    def from_logarithms(cls, values):
        """Create the model from log a, log b and log l."""
        return cls(*namespace(values).exp(values))

    @classmethod
    def start(cls, spacing, num_microphones):
        """Initial model with a = b = spacing² and l = 3 spacing."""
        squared_spacing = host.full(num_microphones, float(spacing) ** 2)
        return cls(squared_spacing, squared_spacing, host.full(num_microphones, 3.0 * spacing))

    @classmethod
    def bounds(cls, extent):
        """Bounds of the logarithms of a, b and l: for a and b as in `InverseSquare`, for l as in `Exponential`."""
        lower_bounds, upper_bounds = InverseSquare.bounds(extent), Exponential.bounds(extent)
        return (*lower_bounds[0], upper_bounds[0][1]), (*lower_bounds[1], upper_bounds[1][1])


def column(values: Float[Array, " M"], other_array: Array) -> Array:
    """Reshape `values` (M,), one per microphone, so that the values broadcast along the first axis of
    `other_array`."""
    return values.reshape((-1,) + (1,) * (other_array.ndim - 1))


def _stack_logarithms(*parameters: Float[Array, " M"]) -> Float[Array, "K M"]:
    """Natural logarithms (K, M) of K parameters of M microphones, one row for each parameter."""
    xp = namespace(parameters)
    return xp.log(xp.stack(parameters))


DECAY_MODELS: dict[str, type[AbstractDecay]] = {
    kind.name: kind for kind in (InverseSquare, Exponential, AttenuatedInverseSquare)
}


def find_decay(name: str | type[AbstractDecay]) -> type[AbstractDecay]:
    """Return the class of the decay model called `name` ("inverse-square", "exponential" or "attenuated"); a class
    given as `name` is returned unchanged. Raises `ValueError` for an unknown name."""
    if isinstance(name, type) and issubclass(name, AbstractDecay):
        return name
    check_name("decay", name, DECAY_MODELS, ", a class like theirs, or 'auto'")
    return DECAY_MODELS[str(name)]
