"""Electrodes whose contact integrals are worked out: for models that are evaluated again and again as they stand."""

import equinox as eqx

from jeit.electrodes.electrodes import AbstractElectrodes, Contact
from jeit.mesh import Mesh


class IntegratedElectrodes(AbstractElectrodes):
    """The contact integrals of other electrodes on one mesh; nothing about the electrodes can be changed any more.

    **Fields**: `integrals`, of the electrodes on the mesh they were made for.
    """

    integrals: Contact
    point: bool = eqx.field(static=True)

    def __init__(self, electrodes: AbstractElectrodes, mesh: Mesh):
        self.integrals = electrodes.contact(mesh)
        self.point = electrodes.is_point

    @property
    def is_point(self) -> bool:
        """As the electrodes they were made of."""
        return self.point

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.integrals.load.shape[1]

    def contact_nodes(self, mesh: Mesh):
        """As the electrodes they were made of."""
        return self.integrals.nodes

    def contact(self, mesh: Mesh) -> Contact:
        """The integrals, as they are."""
        return self.integrals

    def check(self, mesh: Mesh) -> None:
        """Was done when they were made."""
