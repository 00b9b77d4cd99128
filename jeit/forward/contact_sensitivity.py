"""How electrode potentials change with contact impedance: the energy in each contact, from fields that are known.

At fixed fields F the energy of electrode l is E_l(F, F) = (1/z_l) ∫_l (F - Z_l)², so that, F being stationary
(`jeit.forward.transfer`),

    ∂Z / ∂ log z_l = E_l(F, F).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jeit.electrodes.electrodes import AbstractElectrodes
from jeit.mesh import Mesh
from jeit_solvers.engines import on_host

# Ohm·m² beyond which an electrode carries nothing beside one of unit impedance.
_OPEN = 1e30


class _Piece(NamedTuple):
    nodes: Int[np.ndarray, "q k"]
    mass: Float[np.ndarray, "q k k"]


class ContactSensitivity:
    """∂Z/∂ log z of every electrode, on one mesh; `electrodes` of the complete model, whose places and sizes hold."""

    def __init__(self, mesh: Mesh, electrodes: AbstractElectrodes):
        self._pieces: list[list[_Piece]] = []
        self._loads: list[Float[np.ndarray, " n"]] = []
        mesh, number = on_host(mesh), electrodes.num_electrodes
        for electrode in range(number):
            alone = np.where(np.arange(number) == electrode, 1.0, _OPEN)
            contact = on_host(electrodes.with_contact_impedance(alone)).contact(mesh)
            pieces = []
            for nodes, mass in zip(contact.nodes, contact.mass, strict=True):
                touched = np.abs(mass).max(axis=(1, 2)) > 2 / _OPEN * np.abs(mass).max()
                pieces.append(_Piece(np.asarray(nodes)[touched], mass[touched]))
            self._pieces.append(pieces)
            self._loads.append(contact.load[:, electrode])

    def __call__(
        self, fields: Float[np.ndarray, "n L"], impedance: Float[np.ndarray, "L L"], contact_impedance
    ) -> Float[np.ndarray, "L L L"]:
        """∂Z/∂ log z_l (l, L, L) in ohms, from F and Z at these contact impedances (L,)."""
        return (
            np.stack([self._energy(electrode, fields, impedance) for electrode in range(len(impedance))])
            / (np.asarray(contact_impedance)[:, None, None])
        )

    def _energy(self, electrode: int, fields, impedance):
        load, own = self._loads[electrode], impedance[electrode]
        across = np.outer(load @ fields, own)
        energy = load.sum() * np.outer(own, own) - across - across.T
        for nodes, mass in self._pieces[electrode]:
            local = fields[nodes]
            energy += np.einsum("qip,qir->pr", local, np.einsum("qij,qjr->qir", mass, local))
        return energy
