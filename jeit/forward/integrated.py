"""A forward model whose contact integrals are worked out: for calls in which its electrodes stay what they are."""

from __future__ import annotations

from typing import NamedTuple

import jax

from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.precomputed import IntegratedElectrodes
from jeit.forward.system import System
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers.engines import Recent, on_host


class IntegratedModel(NamedTuple):
    """What a forward model is made of, the integrals in place of the electrodes."""

    mesh: Mesh
    electrodes: IntegratedElectrodes
    protocol: Protocol
    system: System


def _integrated(mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol, system: System) -> IntegratedModel:
    with jax.ensure_compile_time_eval():  # or what is kept would belong to the program that is being traced
        return IntegratedModel(mesh, IntegratedElectrodes(electrodes, mesh), protocol, system)


def _on_host(mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol, system: System) -> IntegratedModel:
    # Electrodes of a user's own may work their integrals out in JAX.
    return on_host(_integrated(*on_host((mesh, electrodes, protocol, system))))


# A model is asked for one thing after another, and its electrodes may change while its mesh stays.
integrated_model = Recent(_integrated)
"""The `IntegratedModel` of a mesh, electrodes, a protocol and a system that all have values."""
host_model = Recent(_on_host)
"""The same in NumPy, for what is asked outside compiled code: no call waits for a compiler."""
