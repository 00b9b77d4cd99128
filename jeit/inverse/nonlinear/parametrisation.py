"""Parametrisations of the nonlinear problem: conductivity, and unknowns that are estimated along with it.

Unknowns: further parameters that are not known exactly and can be estimated along with the conductivity.

Each has a prior of zero mean and the given standard deviation, and changes the forward model or the image; its effect
on the voltages is found by automatic differentiation. A positive quantity is estimated by its logarithm and reported as
itself.
"""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float, Int

from jeit.arguments import check_kind
from jeit.electrodes.electrodes import AbstractMovableElectrodes
from jeit.forward import ForwardModel
from jeit.inverse.prior.bases import Regions
from jeit.mesh import Mesh
from jeit_solvers.engines import has_values, namespace


class AbstractUnknown(eqx.Module):
    """Base of all unknowns: `size` values with prior standard deviation `deviation`."""

    deviation: eqx.AbstractVar[Float[Array, " k"]]

    @property
    def size(self) -> int:
        """Number of values k."""
        return self.deviation.shape[0]

    def fits(self, model: ForwardModel) -> bool:
        """Whether it was made for a model like this one."""
        return True

    @abc.abstractmethod
    def apply(
        self, model: ForwardModel, estimate: Float[Array, " m"], values: Float[Array, " k"]
    ) -> tuple[ForwardModel, Float[Array, " m"]]:
        """The model and the image (on the link's scale) with these values in place of zeros."""

    def quantity(self, model: ForwardModel, values: Float[Array, " k"]) -> Float[Array, " k"]:
        """The estimated quantity of each value, in its unit; the values themselves by default."""
        return values


class ContactImpedance(AbstractUnknown):
    """Every electrode's contact impedance, by the logarithm of it over the model's."""

    deviation: Float[Array, " L"]

    def __init__(self, model: ForwardModel, deviation: float = 0.5):
        """`deviation`: of the logarithm. Raises `ValueError` for point electrodes, which have no contact."""
        if model.electrodes.is_point:
            raise ValueError("ContactImpedance: point electrodes have no contact impedance to estimate.")
        self.deviation = _deviation("ContactImpedance", deviation, model.electrodes.num_electrodes)

    def fits(self, model):
        """Whether the model has as many electrodes, with contact."""
        return not model.electrodes.is_point and self.size == model.electrodes.num_electrodes

    def apply(self, model, estimate, values):
        """z exp(values)."""
        impedance = self.quantity(model, values)
        return model.with_electrodes(model.electrodes.with_contact_impedance(impedance)), estimate

    def quantity(self, model, values):
        """Contact impedances z exp(values), ohm·m² (2-D: ohm·m)."""
        return model.electrodes.contact_impedance * jnp.exp(values)


class ElectrodePosition(AbstractUnknown):
    """Displacement of electrodes from their places in the model, metres: along the boundary, or anywhere in a sheet.

    One value for each electrode on the boundary, counter-clockwise; for discs in a sheet two, x of all and then y.
    """

    deviation: Float[Array, " k"]
    direction: Float[Array, "L a 2"]

    def __init__(self, model: ForwardModel, deviation: float):
        """`deviation`: metres. Raises `ValueError` for electrodes of other kinds."""
        electrodes = model.electrodes
        if not isinstance(electrodes, AbstractMovableElectrodes):
            raise ValueError(
                f"ElectrodePosition is for BoundaryElectrodes and SheetDiscs; these are {type(electrodes).__name__}."
            )
        direction = electrodes.directions(model.mesh)
        self.direction = jnp.asarray(direction)
        self.deviation = _deviation("ElectrodePosition", deviation, direction.shape[0] * direction.shape[1])

    def fits(self, model):
        """Whether the model has as many electrodes, of a kind that can move."""
        movable = isinstance(model.electrodes, AbstractMovableElectrodes)
        return movable and self.direction.shape[0] == model.electrodes.num_electrodes

    def apply(self, model, estimate, values):
        """Move the positions."""
        shift = jnp.einsum("al,lad->ld", values.reshape(self.direction.shape[1], -1), self.direction)
        electrodes: Any = model.electrodes
        moved = eqx.tree_at(lambda e: e.position, electrodes, electrodes.position + shift)
        return model.with_electrodes(moved), estimate


class Background(AbstractUnknown):
    """One value added to the image everywhere, on the link's scale (Log: the logarithm of a factor).

    Raises `ValueError` for a deviation that is not positive.
    """

    deviation: Float[Array, " 1"]

    def __init__(self, deviation: float = 0.5):
        self.deviation = _deviation("Background", deviation, 1)

    def apply(self, model, estimate, values):
        """Add a constant to the image."""
        return model, estimate + values[0]


class Scale(AbstractUnknown):
    """A factor on all voltages, by its logarithm: a current or a gain that is not known.

    Raises `ValueError` for a deviation that is not positive.
    """

    deviation: Float[Array, " 1"]

    def __init__(self, deviation: float = 0.1):
        self.deviation = _deviation("Scale", deviation, 1)

    def apply(self, model, estimate, values):
        """Multiply the currents by exp(value)."""
        drive = model.protocol.drive * self.quantity(model, values)[0]
        return eqx.tree_at(lambda m: m.protocol.drive, model, drive), estimate

    def quantity(self, model, values):
        """The factor, exp(value)."""
        return jnp.exp(values)


def _deviation(name: str, deviation, size: int) -> Float[Array, " k"]:
    values = np.asarray(deviation, float)
    if values.shape not in ((), (size,)) or not (np.isfinite(values) & (values > 0)).all():
        raise ValueError(f"{name}: deviation must be positive, one number or {size}; it is {deviation}.")
    return jnp.broadcast_to(jnp.asarray(values), (size,))


# Share of the background that is the least conductivity where nothing else keeps it from zero.
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
        """The values of x for two bounds on σ, in an image about `reference`. Raises `ValueError` for a link that takes
        none."""
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
        """Derivative of the logistic function, largest half way between the bounds."""
        share = _logistic(estimate)
        return (self.upper - self.lower) * share * (1 - share)

    def estimate(self, conductivity):
        """The logit of σ's place between the bounds. Raises `ValueError` outside them."""
        _check_inside(conductivity, self.lower, self.upper)
        share = (conductivity - self.lower) / (self.upper - self.lower)
        xp = namespace(share)
        return xp.log(share) - xp.log1p(-share)

    def ends(self, lower, upper, reference):
        """Not available: the link has bounds of its own. Raises `ValueError`."""
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


def _tuple(unknowns) -> tuple[AbstractUnknown, ...]:
    if not isinstance(unknowns, Sequence) or not all(isinstance(one, AbstractUnknown) for one in unknowns):
        raise ValueError(
            f"unknowns must be a list of those in jeit.inverse.nonlinear, such as [Scale()]; it is {unknowns!r}."
        )
    return tuple(unknowns)


def as_parametrisation(given: "Parametrisation | None") -> "Parametrisation":
    """The parametrisation given, or the default one. Raises `ValueError` for something else."""
    if given is None:
        return Parametrisation()
    check_kind("parametrisation", given, Parametrisation, "a Parametrisation, such as Parametrisation(link=Log())")
    return given


class Parametrisation(eqx.Module):
    """Parametrisation of an image: the quantity that is estimated.

    - `link`: the scale on which the prior acts, `Log()` unless given.
    - `bounds`: least and greatest conductivity, S/m (2-D: S), held exactly; for solvers that keep bounds, with priors
      that have a precision matrix, or total variation.
    - `regions` (m,): integers, cells that share one value; -1 for cells held at the background. See
      `jeit.inverse.prior.bases.pixels`.
    - `unknowns`: what else to estimate, see `jeit.inverse.nonlinear.parametrisation`.
    - `informative`: images consist of those combinations of the prior's shapes whose signal at the background exceeds
      this, in standard deviations of the noise for one of the prior; 0 takes all shapes. None leaves the choice to the
      caller: `reconstruct` takes all, an `Imager` those above 0.03.

    Raises `ValueError` for what does not fit.
    """

    link: AbstractLink = eqx.field(default_factory=Log)
    bounds: tuple[float, float] | None = None
    regions: Int[np.ndarray, " m"] | None = None
    unknowns: tuple[AbstractUnknown, ...] = eqx.field(default=(), converter=_tuple)
    informative: float | None = None

    def __check_init__(self):
        check_kind("link", self.link, AbstractLink, "one of those in jeit.inverse.nonlinear, such as Log()")
        values = np.asarray((0.0, np.inf) if self.bounds is None or not has_values(self.bounds) else self.bounds)
        if values.shape != (2,) or values.dtype.kind not in "iuf" or not 0 <= values[0] < values[1]:
            raise ValueError(f"bounds: give two numbers, 0 ≤ lower < upper, S/m (2-D: S); they are {self.bounds!r}.")
        names = [type(one).__name__ for one in self.unknowns]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"unknowns: {name} is there more than once.")
        if self.informative is not None and not 0 <= self.informative < 1:
            raise ValueError(f"informative must lie between 0 and 1; it is {self.informative}.")

    def check_model(self, model: ForwardModel) -> None:
        """Raises `ValueError` for unknowns that were made for another model."""
        for one in self.unknowns:
            if not one.fits(model):
                name = type(one).__name__
                raise ValueError(f"unknowns: this {name} was made for another model; make it with the one given here.")

    def regions_of(self, mesh: Mesh) -> Regions | None:
        """The regions of this mesh, if there are any. Raises `ValueError` for labels that do not fit it."""
        return None if self.regions is None else Regions.create(mesh, self.regions)

    def box(self, background: Float[Array, " m"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The bounds on the coefficients, one for each cell and then those of the unknowns, which have none.

        Raises `ValueError` for a link that takes no bounds, and a background beyond them.
        """
        lower, upper = (0.0, np.inf) if self.bounds is None else self.bounds
        reference = self.link.estimate(background)
        if has_values(self.bounds):
            lower, upper = float(lower), float(upper)
        ends = self.link.ends(lower, upper, reference)
        if has_values(reference, ends) and not ((reference >= ends[0]) & (reference <= ends[1])).all():
            raise ValueError(f"background must lie between the bounds, {lower:g} and {upper:g}.")
        free = jnp.full(sum(one.size for one in self.unknowns), jnp.inf)
        return jnp.concatenate([ends[0] - reference, -free]), jnp.concatenate([ends[1] - reference, free])
