"""Small models of every kind of electrode in any unit of length, to compare with exact arithmetic."""

import equinox as eqx
import jax
import numpy as np

from jeit.electrodes import BoundaryElectrodes, FaceDiscs, FacePatches, PointElectrodes, SheetDiscs
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import cylinder, disk, layer, rectangle
from jeit.protocol import adjacent


def _boundary(unit: float) -> ForwardModel:
    electrodes = BoundaryElectrodes(unit * ring(0.1, 8, start_angle=0.3), 0.03 * unit, 0.01 * unit * UNLIKE)
    return ForwardModel(disk(0.1 * unit, num_points=60), electrodes, adjacent(8, current=1e-3))


def _inside(unit: float) -> ForwardModel:
    electrodes = SheetDiscs(0.6 * unit * ring(0.1, 6), 0.02 * unit, 1e-4 * unit**2 * UNLIKE[:6])
    return ForwardModel(disk(0.1 * unit, num_points=90), electrodes, adjacent(6, current=1e-3))


def _point(unit: float) -> ForwardModel:
    position = 0.9 * ring(0.1, 8, start_angle=0.2) + [1.3e-3, 0.7e-3]
    return ForwardModel(disk(0.1 * unit, num_points=60), PointElectrodes(unit * position), adjacent(8, current=1e-3))


def _face(unit: float) -> ForwardModel:
    mesh = layer(rectangle(0.1 * unit, 0.08 * unit, num_points=40), 0.01 * unit, 1)
    position = [[x, y, 0.01] for x in (-0.03, 0.0, 0.03) for y in (-0.02, 0.02)]
    electrodes = FaceDiscs(unit * np.array(position), 0.012 * unit, 0.01 * unit * UNLIKE[:6])
    return ForwardModel(mesh, electrodes, adjacent(6, current=1e-3))


def _patch(unit: float) -> ForwardModel:
    mesh = cylinder(0.1 * unit, 0.08 * unit, num_points=200)
    position = unit * ring(0.1, 6, height=float(mesh.points[:, 2].mean()) / unit)
    electrodes = FacePatches(position, 0.045 * unit, 0.045 * unit, 0.01 * unit * UNLIKE[:6])
    return ForwardModel(mesh, electrodes, adjacent(6, current=1e-3))


@eqx.filter_jit
def compiled(model, conductivity):
    """Voltages and their Jacobian, from the fields and by the derivative rule, in one program for all test files."""
    jacobian = model.voltages_and_jacobian(conductivity)[1]
    return model.voltages(conductivity), jacobian, jax.jacrev(model.voltages)(conductivity)


UNLIKE = np.geomspace(1.0, 3.0, 8)
KINDS = {f.__name__.strip("_"): f for f in (_boundary, _inside, _point, _face, _patch)}
CONTACTS = {"tight": 1e-9, "good": 1e-3, "bad": 1e3, "open": 1e9, "unlike": np.array([1e9, 1e-9] * 4)}


def with_contacts(model: ForwardModel, factor) -> ForwardModel:
    """The model with contact impedances multiplied by `factor`, a scalar or one value per electrode."""
    impedance = np.asarray(model.electrodes.contact_impedance)
    factor = np.broadcast_to(factor if np.ndim(factor) == 0 else factor[: len(impedance)], impedance.shape)
    return model.with_electrodes(model.electrodes.with_contact_impedance(factor * impedance))


def uneven(model: ForwardModel) -> np.ndarray:
    """A conductivity (m,) that differs from cell to cell, about 1 S/m (2-D: S)."""
    return np.exp(0.3 * np.random.default_rng(0).normal(size=model.mesh.num_cells))


def middles(model: ForwardModel) -> np.ndarray:
    """Midpoints (m, 2) of the cells, seen from above."""
    return np.asarray(model.mesh.points)[np.asarray(model.mesh.cells)].mean(axis=1)[:, :2]


def miss(found, expected) -> float:
    """The largest error, relative to the largest value."""
    return float(np.abs(np.asarray(found) - expected).max() / np.abs(expected).max())
