"""Electrodes whose contact integrals are worked out: for models that are evaluated again and again as they stand."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jeit.electrodes.electrodes import AbstractElectrodes, Contact, ElectrodePen
from jeit.mesh import Body, Mesh, Refine
from jeit_solvers.engines import has_values, namespace, on_device, on_host


class IntegratedElectrodes(AbstractElectrodes):
    """The contact integrals of other electrodes on one mesh; nothing about the electrodes can be changed any more.

    **Fields**: `integrals`, of the electrodes on the mesh they were made for.
    """

    integrals: Contact
    point: bool = eqx.field(static=True)

    def __init__(self, electrodes: AbstractElectrodes, mesh: Mesh):
        if has_values(electrodes, mesh):
            integrals = on_host(electrodes).contact(on_host(mesh))
            self.integrals = integrals if namespace(electrodes, mesh) is np else on_device(integrals)
        else:
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

    @property
    def contact_impedance(self) -> Float[Array, " L"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Raises `AttributeError`: it is in the integrals."""
        raise AttributeError("IntegratedElectrodes hold integrals only; ask the electrodes that they were made of.")

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractElectrodes:
        """Raises `ValueError`: it is in the integrals."""
        raise ValueError("IntegratedElectrodes cannot be changed; change the electrodes and integrate them anew.")

    def geometry(self) -> dict[str, Any]:
        """Nothing is known any more."""
        return {}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Raises `ValueError`: where they are is not known any more."""
        raise ValueError("IntegratedElectrodes do not say where they are; draw the electrodes that they were made of.")

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """None: they have a mesh."""
        return ()

    def contact_nodes(self, mesh: Mesh):
        """As the electrodes they were made of."""
        return self.integrals.nodes

    def contact(self, mesh: Mesh) -> Contact:
        """The integrals, as they are."""
        return self.integrals

    def check(self, mesh: Mesh) -> None:
        """Was done when they were made."""
