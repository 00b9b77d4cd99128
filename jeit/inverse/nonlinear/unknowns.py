"""Unknowns: further parameters that are not known exactly and can be estimated along with the conductivity.

Each has a prior of zero mean and the given standard deviation, and changes the forward model or the image; its effect
on the voltages is found by automatic differentiation. A positive quantity is estimated by its logarithm and reported as
itself.
"""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jeit.electrodes.electrodes import AbstractMovableElectrodes
from jeit.forward import ForwardModel


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
