"""Parametrisations of the nonlinear problem: the scale of the conductivity, and unknowns estimated along with it.

Unknowns are further parameters that are not known exactly. Each unknown has a normal prior of mean zero and a specified
standard deviation, and changes the forward model or the image. The derivatives of the voltages with respect to unknowns
are computed by automatic differentiation. Positive quantities are estimated through their logarithm.
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
from jeit_solvers.module import Module


class AbstractUnknown(Module):
    """Base of all unknowns. An unknown consists of `size` values with the prior standard deviations `deviation`."""

    deviation: eqx.AbstractVar[Float[Array, " k"]]

    @property
    def size(self) -> int:
        """Number of values k."""
        return self.deviation.shape[0]

    def fits(self, model: ForwardModel) -> bool:
        """Whether the unknown can be used with this model."""
        return True

    @abc.abstractmethod
    def apply(
        self, model: ForwardModel, estimate: Float[Array, " m"], values: Float[Array, " k"]
    ) -> tuple[ForwardModel, Float[Array, " m"]]:
        """Return the model and the image `estimate`, on the link's scale, as changed by the unknown's `values`. Values
        of zero change neither the model nor the image."""

    def quantity(self, model: ForwardModel, values: Float[Array, " k"]) -> Float[Array, " k"]:
        """Estimated quantities in their unit, computed from the values; by default the values themselves."""
        return values


class ContactImpedance(AbstractUnknown):
    """Contact impedance z of every electrode as an unknown. The values are the logarithms of the ratios of the
    estimated to the model's contact impedances.

    **Arguments:**

    - `model`: the forward model that is fitted.
    - `deviation`: prior standard deviation of the logarithms.

    **Example:**

    ```python
    parametrisation = Parametrisation(unknowns=[ContactImpedance(model, 0.2)])
    ```
    """

    deviation: Float[Array, " L"]

    def __init__(self, model: ForwardModel, deviation: float = 0.5):
        """`deviation`: prior standard deviation of the logarithms. Raises `ValueError` for point electrodes, which have
        no contact impedance."""
        if model.electrodes.is_point:
            raise ValueError("ContactImpedance: point electrodes have no contact impedance to estimate.")
        self.deviation = _check_deviation("ContactImpedance", deviation, model.electrodes.num_electrodes)

    def fits(self, model):
        """Whether the model has the same number of electrodes as the unknown, with contact impedance."""
        return not model.electrodes.is_point and self.size == model.electrodes.num_electrodes

    def apply(self, model, estimate, values):
        """Return the model with contact impedances z exp(values), and the unchanged image."""
        impedance = self.quantity(model, values)
        return model.with_electrodes(model.electrodes.with_contact_impedance(impedance)), estimate

    def quantity(self, model, values):
        """Estimated contact impedances z exp(values), ohm·m² (2-D: ohm·m)."""
        return model.electrodes.contact_impedance * jnp.exp(values)


class ElectrodePosition(AbstractUnknown):
    """Displacement of electrodes from their positions in the model, in metres, as an unknown.

    Electrodes on the boundary have one value each, along the boundary, positive counter-clockwise. All other electrodes
    have two values: x and y for discs in a sheet, horizontal and upward for discs and patches on a solid. The first
    values of all electrodes come before the second values.

    **Arguments:**

    - `model`: the forward model that is fitted.
    - `deviation`: prior standard deviation of the displacements, metres.

    **Example:**

    ```python
    parametrisation = Parametrisation(unknowns=[ElectrodePosition(model, 1e-3)])
    ```
    """

    deviation: Float[Array, " k"]
    direction: Float[Array, "L a d"]

    def __init__(self, model: ForwardModel, deviation: float):
        """`deviation`: prior standard deviation in metres. Raises `ValueError` for electrodes that cannot be moved."""
        electrodes = model.electrodes
        if not isinstance(electrodes, AbstractMovableElectrodes):
            raise ValueError(
                "ElectrodePosition is for electrodes that can move: BoundaryElectrodes, SheetDiscs, FaceDiscs and "
                f"FacePatches; these are {type(electrodes).__name__}."
            )
        direction = electrodes.directions(model.mesh)
        self.direction = jnp.asarray(direction)
        self.deviation = _check_deviation("ElectrodePosition", deviation, direction.shape[0] * direction.shape[1])

    def fits(self, model):
        """Whether the model has the same number of electrodes as the unknown, of a kind that can be moved."""
        has_movable_electrodes = isinstance(model.electrodes, AbstractMovableElectrodes)
        return has_movable_electrodes and self.direction.shape[0] == model.electrodes.num_electrodes

    def apply(self, model, estimate, values):
        """Return the model with electrodes displaced by `values`, and the unchanged image."""
        displacements = jnp.einsum("al,lad->ld", values.reshape(self.direction.shape[1], -1), self.direction)
        electrodes: Any = model.electrodes
        moved_electrodes = eqx.tree_at(
            lambda electrodes_to_move: electrodes_to_move.position, electrodes, electrodes.position + displacements
        )
        return model.with_electrodes(moved_electrodes), estimate


class Background(AbstractUnknown):
    """Constant added to the image on the link's scale, as an unknown (with `Log`: the logarithm of a factor on σ).

    **Arguments:**

    - `deviation`: prior standard deviation of the constant.

    Raises `ValueError` if the standard deviation is not positive.

    **Example:**

    ```python
    parametrisation = Parametrisation(unknowns=[Background(0.1)])
    ```
    """

    deviation: Float[Array, " 1"]

    def __init__(self, deviation: float = 0.5):
        self.deviation = _check_deviation("Background", deviation, 1)

    def apply(self, model, estimate, values):
        """Return the unchanged model, and the image plus the constant."""
        return model, estimate + values[0]


class Scale(AbstractUnknown):
    """Factor on all voltages as an unknown, for example due to an unknown current or gain. The value is the logarithm
    of the factor.

    **Arguments:**

    - `deviation`: prior standard deviation of the logarithm.

    Raises `ValueError` if the standard deviation is not positive.

    **Example:**

    ```python
    parametrisation = Parametrisation(unknowns=[Scale(0.05)])
    reconstruct(model, 1.02 * voltages, 1.0, hyperparameter=1.0, parametrisation=parametrisation).unknowns
    ```
    """

    deviation: Float[Array, " 1"]

    def __init__(self, deviation: float = 0.1):
        self.deviation = _check_deviation("Scale", deviation, 1)

    def apply(self, model, estimate, values):
        """Return the model with all currents multiplied by exp(value), and the unchanged image."""
        drive = model.protocol.drive * self.quantity(model, values)[0]
        return eqx.tree_at(lambda scaled_model: scaled_model.protocol.drive, model, drive), estimate

    def quantity(self, model, values):
        """Estimated factor exp(value) on the voltages."""
        return jnp.exp(values)


def _check_deviation(name: str, deviation, num_values: int) -> Float[Array, " k"]:
    deviations = np.asarray(deviation, float)
    if deviations.shape not in ((), (num_values,)) or not (np.isfinite(deviations) & (deviations > 0)).all():
        raise ValueError(f"{name}: deviation must be positive, one number or {num_values}; it is {deviation}.")
    return jnp.broadcast_to(jnp.asarray(deviations), (num_values,))


# Minimum of the lower bound on the conductivity, relative to the mean background, for the linear link.
_MIN_CONDUCTIVITY_RATIO = 1e-6


class AbstractLink(Module):
    """Base of all links: increasing, smooth functions σ(x) that map the estimated quantity x to the conductivity σ."""

    @abc.abstractmethod
    def conductivity(self, estimate: Float[Array, " m"]) -> Float[Array, " m"]:
        """Conductivity σ(x), S/m (2-D: S)."""

    @abc.abstractmethod
    def slope(self, estimate: Float[Array, " m"]) -> Float[Array, " m"]:
        """Derivative dσ/dx of the link at x = `estimate`."""

    @abc.abstractmethod
    def estimate(self, conductivity: Float[Array, " m"]) -> Float[Array, " m"]:
        """Estimated quantity x(σ) for the `conductivity` σ in S/m (2-D: S), the inverse of the link. Raises
        `ValueError` for conductivities outside the link's range."""

    def ends(self, lower: float, upper: float, reference: Float[Array, " m"]) -> tuple[float, float]:
        """Values of x for a `lower` and an `upper` bound on σ; `reference` (m,): x of the background. Raises
        `ValueError` if the link does not allow bounds."""
        raise ValueError(f"bounds: link {type(self).__name__} takes none; take Log() or Linear().")


class Linear(AbstractLink):
    """Linear link σ = x. σ may become negative; a step to a negative σ is shortened.

    **Example:**

    ```python
    parametrisation = Parametrisation(link=Linear())
    reconstruct(model, voltages, 1.0, hyperparameter=1.0, parametrisation=parametrisation).conductivity.min()
    ```
    """

    def conductivity(self, estimate):
        """Conductivity σ = x, S/m (2-D: S)."""
        return estimate

    def slope(self, estimate):
        """Derivative dσ/dx = 1 in every cell."""
        return namespace(estimate).ones_like(estimate)

    def estimate(self, conductivity):
        """Estimate x = σ, in S/m (2-D: S)."""
        return conductivity

    def ends(self, lower, upper, reference):
        """Values of x for two bounds on σ: the bounds themselves, the lower bound at least a millionth of the mean
        background."""
        return namespace(lower, reference).maximum(lower, _MIN_CONDUCTIVITY_RATIO * reference.mean()), upper


class Log(AbstractLink):
    """Logarithmic link σ = exp(x). The conductivity is positive, and the prior treats a ratio of conductivities and the
    inverse ratio alike.

    **Example:**

    ```python
    image = reconstruct(model, voltages, 1.0, hyperparameter=1.0, parametrisation=Parametrisation(link=Log()))
    ```
    """

    def conductivity(self, estimate):
        """Conductivity σ = exp(x), S/m (2-D: S)."""
        return namespace(estimate).exp(estimate)

    def slope(self, estimate):
        """Derivative dσ/dx = exp(x)."""
        return namespace(estimate).exp(estimate)

    def estimate(self, conductivity):
        """Estimate x = log(σ), with σ in S/m (2-D: S). Raises `ValueError` unless σ is positive."""
        _check_inside(conductivity, 0, np.inf)
        return namespace(conductivity).log(conductivity)

    def ends(self, lower, upper, reference):
        """Values of x for two bounds on σ: their logarithms. A lower bound of zero gives -∞, which is no bound."""
        with np.errstate(divide="ignore"):
            return namespace(lower).log(lower), namespace(upper).log(upper)


class Bounded(AbstractLink):
    """Logistic link σ = lower + (upper - lower) / (1 + exp(-x)), which keeps σ strictly between `lower` and `upper`,
    S/m (2-D: S).

    **Arguments:**

    - `lower`, `upper`: limits of the conductivity, S/m (2-D: S).

    Raises `ValueError` unless 0 ≤ lower < upper < ∞.

    **Example:**

    ```python
    parametrisation = Parametrisation(link=Bounded(0.1, 10.0))
    reconstruct(model, voltages, 1.0, hyperparameter=1.0, parametrisation=parametrisation).conductivity.max()
    ```
    """

    lower: float
    upper: float

    def __check_init__(self):
        if has_values(self.lower) and not 0 <= self.lower < self.upper < np.inf:
            raise ValueError(f"Bounded: give 0 ≤ lower < upper, finite; they are {self.lower} and {self.upper}.")

    def conductivity(self, estimate):
        """Conductivity σ, a logistic function of x between the bounds of the link."""
        return self.lower + (self.upper - self.lower) * _logistic(estimate)

    def slope(self, estimate):
        """Derivative dσ/dx of the logistic function, which is largest halfway between the bounds."""
        fraction_of_range = _logistic(estimate)
        return (self.upper - self.lower) * fraction_of_range * (1 - fraction_of_range)

    def estimate(self, conductivity):
        """Estimate x, the logit of (σ - lower) / (upper - lower). Raises `ValueError` for σ outside the bounds."""
        _check_inside(conductivity, self.lower, self.upper)
        fraction_of_range = (conductivity - self.lower) / (self.upper - self.lower)
        xp = namespace(fraction_of_range)
        return xp.log(fraction_of_range) - xp.log1p(-fraction_of_range)

    def ends(self, lower, upper, reference):
        """Not available, because the link has bounds of its own. Raises `ValueError`."""
        raise ValueError("bounds: the link is bounded already; give bounds or link=Bounded(lower, upper), not both.")


def _logistic(estimate):
    return scipy.special.expit(estimate) if isinstance(estimate, np.ndarray) else jax.nn.sigmoid(estimate)


def _check_inside(conductivity, lower_bound, upper_bound) -> None:
    if not has_values(conductivity, lower_bound, upper_bound):
        return
    conductivities = np.asarray(conductivity)
    if not ((conductivities > lower_bound) & (conductivities < upper_bound)).all():
        raise ValueError(
            f"conductivity must lie between {lower_bound:g} and {upper_bound:g}; it goes from "
            f"{conductivities.min():.3g} to {conductivities.max():.3g}."
        )


def _convert_to_tuple(unknowns) -> tuple[AbstractUnknown, ...]:
    if not isinstance(unknowns, Sequence) or not all(isinstance(unknown, AbstractUnknown) for unknown in unknowns):
        raise ValueError(
            f"unknowns must be a list of those in jeit.inverse.nonlinear, such as [Scale()]; it is {unknowns!r}."
        )
    return tuple(unknowns)


def as_parametrisation(parametrisation: "Parametrisation | None") -> "Parametrisation":
    """Return the parametrisation, or the default for None. Raises `ValueError` for any other object."""
    if parametrisation is None:
        return Parametrisation()
    check_kind(
        "parametrisation", parametrisation, Parametrisation, "a Parametrisation, such as Parametrisation(link=Log())"
    )
    return parametrisation


class Parametrisation(Module):
    """Parametrisation of an image: the quantities that are estimated.

    **Arguments:**

    - `link`: scale on which the prior acts, `Log()` by default.
    - `bounds`: minimum and maximum conductivity, S/m (2-D: S), satisfied exactly. Bounds require a solver that keeps
      bounds and a prior that has a precision matrix, or total variation.
    - `regions` (m,): integer label of each cell; cells of the same label share one value, and cells labelled -1 are
      fixed at the background. `pixels` creates labels.
    - `unknowns`: further parameters to estimate: `ContactImpedance`, `ElectrodePosition`, `Background`, `Scale`.
    - `informative`: minimum signal, in standard deviations of the noise, of a combination of the prior's shapes with an
      amplitude of one prior standard deviation, linearised at the background. Images consist of the combinations with a
      larger signal; 0 selects all combinations. None means 0 in `reconstruct` and 0.03 in an `Imager`.

    Raises `ValueError` for invalid values.

    **Example:**

    ```python
    coarse = Parametrisation(link=Linear(), regions=pixels(mesh, (8, 8)))
    reconstruct(model, voltages, 1.0, hyperparameter=1.0, parametrisation=coarse).conductivity
    ```
    """

    link: AbstractLink = eqx.field(default_factory=Log)
    bounds: tuple[float, float] | None = None
    regions: Int[np.ndarray, " m"] | None = None
    unknowns: tuple[AbstractUnknown, ...] = eqx.field(default=(), converter=_convert_to_tuple)
    informative: float | None = None

    def __check_init__(self):
        check_kind("link", self.link, AbstractLink, "one of those in jeit.inverse.nonlinear, such as Log()")
        bound_values = np.asarray((0.0, np.inf) if self.bounds is None or not has_values(self.bounds) else self.bounds)
        if (
            bound_values.shape != (2,)
            or bound_values.dtype.kind not in "iuf"
            or not 0 <= bound_values[0] < bound_values[1]
        ):
            raise ValueError(f"bounds: give two numbers, 0 ≤ lower < upper, S/m (2-D: S); they are {self.bounds!r}.")
        names = [type(unknown).__name__ for unknown in self.unknowns]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"unknowns: {name} is there more than once.")
        if self.informative is not None and not 0 <= self.informative < 1:
            raise ValueError(f"informative must lie between 0 and 1; it is {self.informative}.")

    def check_model(self, model: ForwardModel) -> None:
        """Raise `ValueError` if an unknown does not fit the model, for example in its number of electrodes."""
        for unknown in self.unknowns:
            if not unknown.fits(model):
                name = type(unknown).__name__
                raise ValueError(f"unknowns: this {name} was made for another model; make it with the one given here.")

    def regions_of(self, mesh: Mesh) -> Regions | None:
        """The `Regions` of a mesh with the labels `regions`, or None without labels. Raises `ValueError` for labels
        that do not fit the mesh."""
        return None if self.regions is None else Regions.create(mesh, self.regions)

    def box(self, background: Float[Array, " m"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Lower and upper bounds (n,) on the coefficients: those of the conductivity of the cells, then infinite ones
        of further unknowns.

        Raises `ValueError` if the link does not allow bounds or the background lies outside them.
        """
        lower_bound, upper_bound = (0.0, np.inf) if self.bounds is None else self.bounds
        reference_estimate = self.link.estimate(background)
        if has_values(self.bounds):
            lower_bound, upper_bound = float(lower_bound), float(upper_bound)
        scaled_bounds = self.link.ends(lower_bound, upper_bound, reference_estimate)
        if (
            has_values(reference_estimate, scaled_bounds)
            and not ((reference_estimate >= scaled_bounds[0]) & (reference_estimate <= scaled_bounds[1])).all()
        ):
            raise ValueError(f"background must lie between the bounds, {lower_bound:g} and {upper_bound:g}.")
        infinite_bounds = jnp.full(sum(unknown.size for unknown in self.unknowns), jnp.inf)
        return jnp.concatenate([scaled_bounds[0] - reference_estimate, -infinite_bounds]), jnp.concatenate(
            [scaled_bounds[1] - reference_estimate, infinite_bounds]
        )
