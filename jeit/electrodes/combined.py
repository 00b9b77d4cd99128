"""Electrodes of several kinds on one mesh, such as arcs round the edge of a sheet and a disc in its centre."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.electrodes.electrodes import AbstractElectrodes, Contact, as_electrode_values
from jeit.mesh import Mesh


class CombinedElectrodes(AbstractElectrodes):
    """Complete electrodes of several kinds, numbered one kind after the other.

    **Fields**: `parts`, electrodes none of which is a point electrode.
    """

    parts: tuple[AbstractElectrodes, ...]

    def __init__(self, *parts: AbstractElectrodes):
        """Raises `ValueError` for no parts, or for point electrodes, which have no contact to combine."""
        if not parts:
            raise ValueError("CombinedElectrodes needs at least one set of electrodes.")
        for part in parts:
            if part.is_point:
                raise ValueError(
                    f"{type(part).__name__} cannot be combined with complete electrodes: give them a size and a "
                    "contact impedance (SheetDiscs, FaceDiscs), or make all electrodes points."
                )
        self.parts = parts

    @property
    def is_point(self) -> bool:
        """No."""
        return False

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L of all parts together."""
        return sum(part.num_electrodes for part in self.parts)

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """The facets and cells of all parts."""
        return tuple(nodes for part in self.parts for nodes in part.contact_nodes(mesh))

    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals of all parts, side by side."""
        contacts = [part.contact(mesh) for part in self.parts]
        return Contact(
            tuple(nodes for contact in contacts for nodes in contact.nodes),
            tuple(mass for contact in contacts for mass in contact.mass),
            jnp.concatenate([contact.load for contact in contacts], axis=1),
        )

    def check(self, mesh: Mesh) -> None:
        """Check every part on its own."""
        for part in self.parts:
            part.check(mesh)


def contact_impedance(electrodes: AbstractElectrodes) -> Float[Array, " L"]:
    """Contact impedances (L,) of complete electrodes, ohm·m² (ohm·m for arcs). Raises `ValueError` for points."""
    if isinstance(electrodes, CombinedElectrodes):
        return jnp.concatenate([contact_impedance(part) for part in electrodes.parts])
    _refuse_points(electrodes)
    return vars(electrodes)["contact_impedance"]


def with_contact_impedance(electrodes: AbstractElectrodes, contact_impedance) -> AbstractElectrodes:
    """The same electrodes with other contact impedances: one number or (L,). Raises `ValueError` for points."""
    _refuse_points(electrodes)
    values = as_electrode_values("contact_impedance", contact_impedance, electrodes.num_electrodes, unit="ohm·m²")
    if isinstance(electrodes, CombinedElectrodes):
        ends = np.cumsum([part.num_electrodes for part in electrodes.parts])[:-1]
        pieces = jnp.split(values, ends)
        return CombinedElectrodes(*map(with_contact_impedance, electrodes.parts, pieces))
    return eqx.tree_at(lambda each: each.contact_impedance, electrodes, values)


def _refuse_points(electrodes: AbstractElectrodes) -> None:
    if electrodes.is_point:
        raise ValueError(f"{type(electrodes).__name__} have no contact impedance.")
