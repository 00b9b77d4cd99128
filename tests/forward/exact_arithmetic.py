"""The forward model in decimal arithmetic of sixty digits: its voltages without rounding errors."""

from decimal import Decimal, localcontext
from typing import NamedTuple

import numpy as np

from jeit.electrodes.electrodes import Contact

DIGITS = 60
# Contact impedance in ohm·m² of an electrode that is practically open beside one of unit impedance.
_OPEN = 1e300
_decimal = np.frompyfunc(lambda number: Decimal(float(number)), 1, 1)


class Exact(NamedTuple):
    """`voltages` (M,), transfer `impedance` (L, L) and `jacobian` (M, m) with respect to the cells' conductivities."""

    voltages: np.ndarray
    impedance: np.ndarray
    jacobian: np.ndarray


def exact(model, conductivity) -> Exact:
    """Exact results of a model with one conductivity per cell (m,), S/m (2-D: S)."""
    with localcontext() as context:
        context.prec = DIGITS
        fields, impedance, gradient, measure = _of(model, conductivity)
        drive, measurement, driven, measured = _protocol(model)
        cells = np.asarray(model.mesh.cells)
        flow = [_along(fields @ patterns.T, cells, gradient) for patterns in (drive, measurement)]
        jacobian = -measure[:, None] * (flow[0][:, :, driven] * flow[1][:, :, measured]).sum(axis=1)
        voltages = (measurement @ impedance @ drive.T)[measured, driven]
        return Exact(*(np.asarray(one, float) for one in (voltages, impedance, jacobian.T)))


def exact_change(model, before, after) -> np.ndarray:
    """Exact change of the voltages (M,) from one conductivity per cell (m,) to another, S/m (2-D: S)."""
    with localcontext() as context:
        context.prec = DIGITS
        first, second = (_of(model, one)[1] for one in (before, after))
        drive, measurement, driven, measured = _protocol(model)
        return np.asarray((measurement @ (second - first) @ drive.T)[measured, driven], float)


def _protocol(model):
    protocol = model.protocol
    indices = np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)
    return _decimal(np.asarray(protocol.drive)), _decimal(np.asarray(protocol.measurement)), *indices


def _of(model, conductivity):
    """Fields, Z, and the gradients and measures of the cells."""
    gradient, measure = _gradients(model.mesh)
    weight = measure * _decimal(np.asarray(conductivity))
    return *_solved(model, np.asarray(model.mesh.cells), gradient, weight), gradient, measure


def _gradients(mesh):
    """Gradients (m, d + 1, d) of the cells' basis functions, and their measures (m,)."""
    corners = _decimal(np.asarray(mesh.points))[np.asarray(mesh.cells)]
    edges = corners[:, 1:] - corners[:, :1]  # (m, d, d)
    d = edges.shape[1]
    if d == 2:
        (a, b), (c, e) = edges[:, 0].T, edges[:, 1].T
        size = a * e - b * c
        cofactors = np.array([[e, -c], [-b, a]]).transpose(2, 0, 1)
    else:
        u, v, w = (edges[:, k] for k in range(3))
        cofactors = np.stack([_cross(v, w), _cross(w, u), _cross(u, v)], axis=1)
        size = (u * cofactors[:, 0]).sum(axis=1)
    inner = cofactors / size[:, None, None]
    return np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1), abs(size) / (2 if d == 2 else 6)


def _cross(one, other):
    after, before = [1, 2, 0], [2, 0, 1]
    return one[:, after] * other[:, before] - one[:, before] * other[:, after]


def _along(fields, cells, gradient):
    """Gradients (m, d, p) of nodal fields (n, p)."""
    return (gradient[..., None] * fields[cells][:, :, None]).sum(axis=1)


def _solved(model, cells, gradient, weight):
    """Potentials (n, L) for a unit current into each electrode that leaves evenly through all electrodes, and Z (L,
    L)."""
    electrodes, mesh = model.electrodes, model.mesh
    size, number = mesh.num_points, electrodes.num_electrodes
    matrix = np.full((size + number, size + number), Decimal(0), object)
    element = weight[:, None, None] * (gradient[:, :, None] * gradient[:, None]).sum(axis=-1)
    np.add.at(matrix, (cells[:, :, None], cells[:, None]), element)
    unit = _decimal(np.eye(number)) - Decimal(1) / number
    if electrodes.is_point:
        load = _decimal(np.asarray(electrodes.contact(mesh).load))
        matrix[0, 0] += 1
        fields = _solve(matrix[:size, :size], load @ unit)
        return fields, unit @ (load.T @ fields)
    for electrode, impedance in enumerate(np.asarray(electrodes.contact_impedance)):
        alone = np.where(np.arange(number) == electrode, 1.0, _OPEN)
        contact: Contact = electrodes.with_contact_impedance(alone).contact(mesh)
        at = size + electrode
        for nodes, mass in zip(contact.nodes, contact.mass, strict=True):
            nodes, mass = np.asarray(nodes), np.asarray(mass)
            some = np.abs(mass).max(axis=(1, 2)) > 1e-200
            nodes, mass = nodes[some], _decimal(mass[some]) / Decimal(float(impedance))
            np.add.at(matrix, (nodes[:, :, None], nodes[:, None]), mass)
            load = mass.sum(axis=2)
            np.add.at(matrix[:, at], nodes, -load)
            np.add.at(matrix[at], nodes, -load)
            matrix[at, at] += load.sum()
    matrix[-1, -1] += 1
    right = np.full((size + number, number), Decimal(0), object)
    right[size:] = unit
    found = _solve(matrix, right)
    impedance = unit @ found[size:]
    return found[:size], impedance


def _solve(matrix, right):
    """Solve by elimination without pivoting, which a positive definite matrix permits."""
    matrix, right = matrix.copy(), right.copy()
    size = len(matrix)
    for k in range(size):
        below = k + 1 + np.flatnonzero(matrix[k + 1 :, k] != 0)
        if not below.size:
            continue
        factor = matrix[below, k] / matrix[k, k]
        across = k + np.flatnonzero(matrix[k, k:] != 0)
        matrix[np.ix_(below, across)] -= factor[:, None] * matrix[k, across]
        right[below] -= factor[:, None] * right[k]
    for k in reversed(range(size)):
        after = k + 1 + np.flatnonzero(matrix[k, k + 1 :] != 0)
        right[k] = (right[k] - matrix[k, after] @ right[after]) / matrix[k, k]
    return right
