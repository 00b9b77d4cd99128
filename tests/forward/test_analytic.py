"""The forward model against solutions in closed form or by series.

What P1 elements of size h should do, u the driven and w the measuring field, both exact:

- the error of a voltage is the energy product of the errors of u and w (Galerkin orthogonality), at most
  C h² |u|₂ |w|₂ where both have second derivatives: order 2. The polygon inscribed in the disk, and a
  polygonal inclusion, cost h² too.
- at the edge of a complete electrode u ~ r log r, whose second derivatives miss being square integrable by a
  logarithm, and a point electrode's u ~ log r misses by far more. Where only one of the two fields is singular, that
  is, on measurements that touch no driven electrode, order 2 remains (but for a logarithm that weakly
  shunting electrodes hide); where electrodes both drive and measure, h² log(1/h).
- z must be resolved: orders appear once h is well below the length σz that the current spreads over.
"""

from functools import cache

import numpy as np
import pytest

from jeit.electrodes import (
    BoundaryElectrodes,
    CombinedElectrodes,
    FacetElectrodes,
    NodeElectrodes,
    PointElectrodes,
    SheetDiscs,
    plates,
)
from jeit.forward import ForwardModel
from jeit.forward.exact import (
    ConductingDisk,
    arc_transfer_impedance,
    centre_to_rim_resistance,
    disc_transfer_impedance,
    plate_resistance,
    point_inclusion_effect,
    point_potentials,
    point_transfer_impedance,
)
from jeit.mesh import Refine, box, centroids, disk, rectangle
from jeit.protocol import adjacent, from_matrices

RADIUS = 0.1
CONDUCTIVITY = 0.5
HOMOGENEOUS = ConductingDisk(RADIUS, CONDUCTIVITY)
INCLUSION = ConductingDisk(RADIUS, CONDUCTIVITY, 0.5, 4.0 * CONDUCTIVITY)
LOSSY = ConductingDisk(RADIUS, CONDUCTIVITY * (1.0 + 0.3j), 0.5, CONDUCTIVITY * (0.2 - 0.1j))
# Electrodes cover half of the rim and end at multiples of 1/32 turn, where structured meshes have nodes.
ANGLES = 2.0 * np.pi * (np.arange(16) + 0.25) / 16.0
WIDTH = 2.0 * np.pi * RADIUS / 32.0
# σz is RADIUS / 10: the current spreads over half an electrode.
CONTACT_IMPEDANCE = RADIUS / CONDUCTIVITY / 10.0
PROTOCOL = adjacent(16, current=1.0)  # 208 voltages, none on a driven electrode


def on_rim(angles: np.ndarray) -> np.ndarray:
    return RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


@cache
def ring_mesh(num_rings: int):
    """A disk of concentric rings of equal thickness, each with six nodes more than the next inner one."""
    mesh = disk(RADIUS, num_points=1 + 3 * num_rings * (num_rings + 1))
    assert mesh.num_facets == 6 * num_rings
    return mesh


def cells_of(physics: ConductingDisk, mesh) -> np.ndarray | complex:
    """Conductivity per cell; with an even number of rings the inclusion consists of whole cells."""
    inside = np.linalg.norm(centroids(mesh), axis=1) < physics.inclusion_ratio * physics.radius
    return np.where(inside, physics.inclusion_conductivity, physics.conductivity)


def adjacent_voltages(transfer_impedance: np.ndarray) -> np.ndarray:
    table = np.asarray(PROTOCOL.measurement) @ transfer_impedance @ np.asarray(PROTOCOL.drive).T
    return table[np.asarray(PROTOCOL.measurement_index), np.asarray(PROTOCOL.drive_index)]


def arc_voltages(physics: ConductingDisk, mesh, contact_impedance=CONTACT_IMPEDANCE, angles=ANGLES) -> np.ndarray:
    electrodes = BoundaryElectrodes(on_rim(angles), WIDTH, contact_impedance)
    return np.asarray(ForwardModel(mesh, electrodes, PROTOCOL).voltages(cells_of(physics, mesh)))


def exact_arc_voltages(physics: ConductingDisk, contact_impedance=CONTACT_IMPEDANCE, angles=ANGLES) -> np.ndarray:
    widths, impedance = np.full(16, WIDTH), np.full(16, contact_impedance)
    return adjacent_voltages(arc_transfer_impedance(physics, angles, widths, impedance))


def largest(error: np.ndarray, exact: np.ndarray) -> float:
    """The relative error of the worst channel."""
    return float(np.max(np.abs(error / exact)))


def overall(value: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(value - exact) / np.linalg.norm(exact))


def fitted_order(sizes, errors) -> float:
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


LEVELS = [
    pytest.param((16, 32), id="to 3,000 nodes"),
    pytest.param((16, 32, 64), id="to 12,500 nodes", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("levels", LEVELS)
@pytest.mark.parametrize(
    "physics",
    [HOMOGENEOUS, INCLUSION, pytest.param(LOSSY, marks=pytest.mark.slow)],
    ids=["homogeneous", "inclusion", "complex"],
)
def test_arcs_converge_to_the_series(levels, physics):
    exact = exact_arc_voltages(physics)
    errors = [overall(arc_voltages(physics, ring_mesh(rings)), exact) for rings in levels]
    assert fitted_order(1.0 / np.array(levels), errors) == pytest.approx(2.0, abs=0.15)
    assert errors[1] < 3e-3  # 32 rings, 3,169 nodes


@pytest.mark.slow
def test_driven_arcs_converge_with_a_logarithm():
    """The whole transfer impedance including driven electrodes: h² (A log(1/h) + B)."""
    levels, impedance = (16, 32, 48, 64, 96), 10.0 * CONTACT_IMPEDANCE
    exact = arc_transfer_impedance(HOMOGENEOUS, ANGLES, np.full(16, WIDTH), np.full(16, impedance))
    electrodes = BoundaryElectrodes(on_rim(ANGLES), WIDTH, impedance)
    sizes = 1.0 / np.array(levels)
    errors = np.array(
        [
            overall(ForwardModel(ring_mesh(r), electrodes, PROTOCOL).transfer_impedance(CONDUCTIVITY), exact)
            for r in levels
        ]
    )
    # Plain h² would leave errors / sizes² constant; h^1.85 and less, or any first-order term, bends the line in
    # log(1/h).
    line = np.polyfit(-np.log(sizes), errors / sizes**2, 1)
    assert line[0] > 0.0
    assert np.abs(np.polyval(line, -np.log(sizes)) / (errors / sizes**2) - 1.0).max() < 0.01


@pytest.mark.parametrize("levels", LEVELS)
@pytest.mark.parametrize("physics", [HOMOGENEOUS, INCLUSION], ids=["homogeneous", "inclusion"])
@pytest.mark.slow
def test_points_converge_to_the_logarithm(levels, physics):
    angles = 2.0 * np.pi * np.arange(16) / 16.0
    exact = adjacent_voltages(point_transfer_impedance(physics, angles))
    errors = []
    for rings in levels:
        mesh = ring_mesh(rings)
        nodes = np.argmin(np.linalg.norm(np.asarray(mesh.points)[:, None] - on_rim(angles), axis=-1), axis=0)
        model = ForwardModel(mesh, NodeElectrodes(nodes), PROTOCOL)
        errors.append(overall(model.voltages(cells_of(physics, mesh)), exact))
    # The same points, found by position on the last mesh.
    free = ForwardModel(mesh, PointElectrodes(on_rim(angles)), PROTOCOL)
    assert overall(free.voltages(cells_of(physics, mesh)), exact) == pytest.approx(errors[-1], rel=1e-6)
    assert fitted_order(1.0 / np.array(levels), errors) == pytest.approx(2.0, abs=0.15)
    assert errors[1] < 1.5e-3


def test_inclusion_with_driven_points():
    """The change by an inclusion has no singularity: every entry, the diagonal too, is finite and converges."""
    angles = 2.0 * np.pi * np.arange(16) / 16.0
    centring = np.eye(16) - 1.0 / 16.0
    exact = centring @ point_inclusion_effect(INCLUSION, angles) @ centring
    errors = []
    for rings in (16, 32):
        mesh = ring_mesh(rings)
        model = ForwardModel(mesh, PointElectrodes(on_rim(angles)), PROTOCOL)
        effect = model.transfer_impedance(cells_of(INCLUSION, mesh)) - model.transfer_impedance(CONDUCTIVITY)
        errors.append(overall(effect, exact))
    assert errors[1] < 5e-3
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15)


def test_potentials_inside():
    angles = 2.0 * np.pi * np.arange(16) / 16.0
    mesh = ring_mesh(32)
    model = ForwardModel(mesh, PointElectrodes(on_rim(angles)), PROTOCOL)
    # Away from the sources the potential is smooth; its reference is arbitrary.
    inner = np.linalg.norm(mesh.points, axis=1) < 0.5 * RADIUS
    potentials = np.asarray(model.potentials(CONDUCTIVITY))[:, inner]
    drive = np.asarray(PROTOCOL.drive)
    exact = point_potentials(HOMOGENEOUS, angles, drive.T, np.asarray(mesh.points)[inner]).T
    difference = potentials - exact
    difference -= difference.mean(axis=1, keepdims=True)
    assert np.abs(difference).max() < 2e-3 * np.abs(exact).max()  # (h / distance to a source)² = 4e-3


@pytest.mark.parametrize(
    ("num_points", "tolerance"),
    [(1_200, 5e-3), pytest.param(10_000, 1e-3, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("spread", [0.1, 0.02])
def test_every_voltage_on_a_mesh_graded_to_the_electrodes(num_points, tolerance, spread):
    """Electrodes anywhere on the rim; the mesh is refined at their ends, which need not be nodes."""
    angles = ANGLES + 0.07
    half = WIDTH / RADIUS / 2.0
    ends = on_rim(np.concatenate([angles - half, angles + half]))
    mesh = disk(RADIUS, num_points=num_points, refine=Refine(ends, factor=5.0, growth=0.25))
    assert mesh.num_points == pytest.approx(num_points, rel=0.03)
    impedance = spread * RADIUS / CONDUCTIVITY
    exact = exact_arc_voltages(HOMOGENEOUS, impedance, angles)
    assert largest(arc_voltages(HOMOGENEOUS, mesh, impedance, angles) - exact, exact) < tolerance


@pytest.mark.parametrize("num_rings", [20, pytest.param(58, marks=pytest.mark.slow)])
def test_every_voltage_of_points_on_a_uniform_mesh(num_rings):
    """Worst channel: 0.5 % at 1,261 nodes and 0.1 % at 10,267."""
    angles = 2.0 * np.pi * np.arange(6) / 6.0  # six-fold meshes have nodes there
    drive = np.eye(6) - np.roll(np.eye(6), 1, axis=1)
    exact_impedance = point_transfer_impedance(HOMOGENEOUS, angles)
    protocol = adjacent(6, current=1.0)
    model = ForwardModel(ring_mesh(num_rings), PointElectrodes(on_rim(angles)), protocol)
    table = drive @ exact_impedance @ drive.T
    exact = table[np.asarray(protocol.measurement_index), np.asarray(protocol.drive_index)]
    tolerance = 5e-3 if num_rings == 20 else 1e-3
    assert largest(np.asarray(model.voltages(CONDUCTIVITY)) - exact, exact) < tolerance


DISC_POSITION = RADIUS * np.array([[0.03, 0.02], [0.5, 0.1], [-0.4, 0.3], [-0.1, -0.6], [0.35, -0.5]])
DISC_RADIUS = RADIUS * np.array([0.1, 0.15, 0.12, 0.2, 0.12])
DISC_IMPEDANCE = RADIUS**2 / CONDUCTIVITY * np.array([0.003, 0.02, 0.01, 0.005, 0.004])


@pytest.mark.slow
def test_disc_windows_converge_to_sharp_discs():
    """Window and cells shrink together; the exact field of sharp discs has no singularity, so the order is 2."""
    exact = disc_transfer_impedance(HOMOGENEOUS, DISC_POSITION, DISC_RADIUS, DISC_IMPEDANCE)
    electrodes = SheetDiscs(DISC_POSITION, DISC_RADIUS, DISC_IMPEDANCE)
    protocol = adjacent(5, current=1.0)
    levels = (24, 32, 48, 64, 96)
    errors = [
        overall(ForwardModel(ring_mesh(rings), electrodes, protocol).transfer_impedance(CONDUCTIVITY), exact)
        for rings in levels
    ]
    assert fitted_order(1.0 / np.array(levels), errors) == pytest.approx(2.0, abs=0.15)
    assert errors[levels.index(48)] < 2.5e-3


@pytest.mark.slow
def test_disc_in_the_middle_and_the_whole_rim():
    """Two kinds of electrode on one sheet, with Bessel functions under the disc."""
    radius, impedance, rim = 0.3 * RADIUS, 0.01 * RADIUS**2 / CONDUCTIVITY, 0.2 * RADIUS / CONDUCTIVITY
    exact = centre_to_rim_resistance(HOMOGENEOUS, radius, impedance, rim)
    errors = []
    for rings in (16, 32):
        mesh = ring_mesh(rings)
        electrodes = CombinedElectrodes(
            SheetDiscs(np.zeros((1, 2)), radius, impedance),
            FacetElectrodes(mesh, [np.arange(mesh.num_facets)], rim),
        )
        pair = from_matrices(np.array([[1.0, -1.0]]), np.array([[1.0, -1.0]]))
        voltage = ForwardModel(mesh, electrodes, pair).voltages(CONDUCTIVITY)[0]
        errors.append(abs(voltage / exact - 1.0))
    assert errors[1] < 2e-3
    assert np.log2(errors[0] / errors[1]) > 1.7  # order 2, up to the position of the disc's edge relative to the rings


@pytest.mark.parametrize("conductivity", [0.7, 0.7 + 0.2j], ids=["real", "complex"])
def test_box_between_plates(conductivity):
    pair = from_matrices(np.array([[1.0, -1.0]]), np.array([[1.0, -1.0]]))
    length, depth, height, impedance = 0.2, 0.05, 0.03, 0.004

    sheet = rectangle(length, depth, num_points=150)
    flat = ForwardModel(sheet, plates(sheet, ["left", "right"], impedance), pair)
    resistance = plate_resistance(length, depth, conductivity, impedance)
    assert abs(flat.voltages(conductivity)[0] / resistance - 1.0) < 1e-10

    solid = box(length, depth, height, num_points=300)
    full = ForwardModel(solid, plates(solid, ["left", "right"], impedance), pair)
    resistance = plate_resistance(length, depth * height, conductivity, impedance)
    assert abs(full.voltages(conductivity)[0] / resistance - 1.0) < 1e-10
