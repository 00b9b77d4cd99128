"""A forward model in NumPy, for what is asked of it outside compiled code: no call waits for a compiler."""

from typing import NamedTuple

from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.precomputed import IntegratedElectrodes
from jeit.forward.system import System
from jeit.mesh import Mesh
from jeit.protocol import Protocol
from jeit_solvers.engines import Recent, on_host


class HostModel(NamedTuple):
    """A forward model with NumPy's arrays, its contact integrals worked out."""

    mesh: Mesh
    electrodes: IntegratedElectrodes
    protocol: Protocol
    system: System


def _host_model(mesh: Mesh, electrodes: AbstractElectrodes, protocol: Protocol, system: System) -> HostModel:
    mesh, electrodes, protocol, system = on_host((mesh, electrodes, protocol, system))
    # Electrodes of a user's own may have worked their integrals out in JAX.
    return HostModel(mesh, on_host(IntegratedElectrodes(electrodes, mesh)), protocol, system)


# A model is asked for one thing after another, and its electrodes may change while its mesh stays.
host_model = Recent(_host_model)
