"""A tank that needs no forward model: a disk with point electrodes, whose transfer impedance is a logarithm."""

from collections.abc import Callable

import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import Protocol

RADIUS = 0.1


def disk_voltages(protocol: Protocol, change: float = 0.0) -> np.ndarray:
    """Voltages (M,) of a homogeneous disk of 1 mS with small electrodes, the first at 12 o'clock, then clockwise.

    `change` times the largest impedance is added as a further symmetric term: a change of the body that differs from
    noise.
    """
    position = ring(RADIUS, protocol.num_electrodes, clockwise=True)
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    np.fill_diagonal(distance, 1e-4)
    impedance = -np.log(distance / RADIUS) / (np.pi * 1e-3)
    touched = np.exp(-((position - position[0]) ** 2).sum(axis=1) / RADIUS**2)
    impedance = impedance + change * impedance.max() * np.outer(touched, touched)
    potentials = np.asarray(protocol.drive) @ impedance
    return np.einsum("kl,kl->k", protocol.channel_measurement, potentials[np.asarray(protocol.drive_index)])


@pytest.fixture(scope="session")
def tank() -> Callable[..., np.ndarray]:
    """The function `disk_voltages`."""
    return disk_voltages


@pytest.fixture(scope="session")
def setup() -> Callable[[int], dict]:
    """Electrodes and domain of that disk, as keyword arguments of `screen`."""

    def build(count: int) -> dict:
        position = ring(RADIUS, count, clockwise=True)
        return {"electrodes": BoundaryElectrodes(position, 1e-3, 0.01), "domain": Disk(RADIUS)}

    return build
