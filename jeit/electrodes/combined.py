"""Electrodes of several kinds on one mesh, such as arcs round the edge of a sheet and a disc in its centre."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.electrodes.electrodes import (
    AbstractCompleteElectrodes,
    AbstractElectrodes,
    Contact,
    ElectrodePen,
    as_electrode_values,
)
from jeit.mesh import Body, Mesh, Refine
from jeit_solvers.engines import namespace, values_at_once


class CombinedElectrodes(AbstractCompleteElectrodes):
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
    def contact_impedance(self) -> Float[Array, " L"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Contact impedances (L,) of all parts, ohm·m² (ohm·m for arcs)."""
        return namespace(self).concatenate([part.contact_impedance for part in self.parts])

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractCompleteElectrodes:
        """The same electrodes with other contact impedances, ohm·m² (ohm·m for arcs). Raises `ValueError`."""
        values = as_electrode_values("contact_impedance", contact_impedance, self.num_electrodes, unit="ohm·m²")
        pieces = jnp.split(values, np.cumsum([part.num_electrodes for part in self.parts])[:-1])
        return CombinedElectrodes(
            *(part.with_contact_impedance(piece) for part, piece in zip(self.parts, pieces, strict=True))
        )

    def geometry(self) -> dict[str, Any]:
        """Every part's own description."""
        return {"parts": [part.describe() for part in self.parts]}

    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw all parts, one after the other."""
        for part in self.parts:
            part.draw(mesh, pen)

    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Refinement of all parts."""
        return tuple(refine for part in self.parts for refine in part.refinement(body))

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """The facets and cells of all parts."""
        return tuple(nodes for part in self.parts for nodes in part.contact_nodes(mesh))

    @values_at_once
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals of all parts, side by side."""
        contacts = [part.contact(mesh) for part in self.parts]
        return Contact(
            tuple(nodes for contact in contacts for nodes in contact.nodes),
            tuple(mass for contact in contacts for mass in contact.mass),
            namespace(contacts).concatenate([contact.load for contact in contacts], axis=1),
        )

    def check(self, mesh: Mesh) -> None:
        """Check every part on its own; raises `ValueError` as they do."""
        for part in self.parts:
            part.check(mesh)
