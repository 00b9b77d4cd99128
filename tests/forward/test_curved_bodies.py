"""The forward model on surfaces, shells and solids against series solutions: order of convergence, and error bounds."""

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit import protocol
from jeit.electrodes import FaceDiscs, FacePatches, NodeElectrodes, PointElectrodes, plates
from jeit.forward import ForwardModel
from jeit.forward.exact import (
    ConductingCylinder,
    ConductingSphere,
    cap_impedance,
    face_patch_impedance,
    plate_resistance,
    sleeve_sheet_impedance,
    sphere_sheet_impedance,
    wall_patch_impedance,
)
from jeit.mesh import bend, box, cylinder, layer, rectangle, shell, sphere, tube

CONDUCTIVITY = 2.0
# Contact impedance so large that the current density under an electrode is uniform to a millionth.
CONTACT = 1e4
RADIUS, HEIGHT = 0.05, 0.08


def error(mesh, electrodes, impedance, conductivity=CONDUCTIVITY):
    """Largest error of adjacent channels without driven electrodes, relative to the largest voltage."""
    pattern = protocol.adjacent(electrodes.num_electrodes)
    found = np.asarray(ForwardModel(mesh, electrodes, pattern).voltages(conductivity))
    measured = np.asarray(pattern.measurement)[np.asarray(pattern.measurement_index)]
    driven = np.asarray(pattern.drive)[np.asarray(pattern.drive_index)]
    expected = ((measured @ impedance) * driven).sum(axis=1)
    return np.abs(found - expected).max() / np.abs(expected).max()


def order(errors, steps):
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


def nodes_at(mesh, places):
    points = np.asarray(mesh.points)
    nodes = np.array([np.linalg.norm(points - place, axis=1).argmin() for place in places])
    np.testing.assert_allclose(points[nodes], places, atol=1e-12)
    return NodeElectrodes(nodes)


def icosahedron():
    """Corners (12, 3) of an icosahedron in the unit sphere: nodes of every mesh of `sphere`."""
    return np.asarray(sphere(1.0, num_points=12).points)


def on_wall():
    """Angles, heights and positions of six patches on the wall of a cylinder, in two rings."""
    angles = 2 * np.pi * np.arange(6) / 6 + 0.2
    heights = np.where(np.arange(6) % 2, 0.055, 0.025)
    return angles, heights, np.stack([RADIUS * np.cos(angles), RADIUS * np.sin(angles), heights], axis=1)


def wall_patches():
    """Patches 30 mm round the cylinder by 30 mm."""
    return FacePatches(on_wall()[2], 2 * RADIUS * np.sin(0.03 / (2 * RADIUS)), 0.03, CONTACT)


def test_points_on_a_sphere():
    places, parts = 0.1 * icosahedron(), np.array([4, 8, 16])
    exact = sphere_sheet_impedance(places, 0.01)
    meshes = [sphere(0.1, num_points=10 * k * k + 2) for k in parts]
    errors = [error(mesh, nodes_at(mesh, places), exact, 0.01) for mesh in meshes]
    assert order(errors, 1 / parts) == pytest.approx(2, abs=0.1)
    assert errors[-1] < 6e-4


def test_points_on_the_edges_of_a_sleeve():
    around, height = 2 * np.pi * np.arange(8) / 8, np.sqrt(3) / 2 * 2 * np.pi * RADIUS / 16 * 6
    angles, heights = np.tile(around, 2), np.repeat([0.0, height], 8)
    places = np.stack([RADIUS * np.cos(angles), RADIUS * np.sin(angles), heights], axis=1)
    exact, errors, counts = sleeve_sheet_impedance(RADIUS, height, angles, heights, 0.01), [], np.array([16, 32, 64])
    for number in counts:
        mesh = tube(RADIUS, height, num_around=int(number))
        errors.append(error(mesh, nodes_at(mesh, places), exact, 0.01))
    assert order(errors, 1 / counts) == pytest.approx(2.15, abs=0.2)
    assert errors[-1] < 1.2e-3


def test_points_anywhere_on_a_sleeve():
    rng = np.random.default_rng(0)
    angles, heights = rng.uniform(0, 2 * np.pi, 8), rng.uniform(0.01, 0.09, 8)
    places = np.stack([RADIUS * np.cos(angles), RADIUS * np.sin(angles), heights], axis=1)
    exact, errors, counts = sleeve_sheet_impedance(RADIUS, 0.1, angles, heights, 0.01), [], np.array([20, 40, 80])
    for number in counts:
        errors.append(error(tube(RADIUS, 0.1, num_around=int(number)), PointElectrodes(places), exact, 0.01))
    assert order(errors, 1 / counts) > 1.5
    assert errors[-1] < 5e-3


def test_patches_on_a_cylindrical_shell():
    angles, heights, _ = on_wall()
    exact = wall_patch_impedance(ConductingCylinder(RADIUS, HEIGHT, CONDUCTIVITY, 0.04), angles, heights, (0.03, 0.03))
    sizes = [(0.008, 1), (0.004, 2)]
    meshes = [shell(tube(0.04, HEIGHT, cell_size=size), 0.01, layers) for size, layers in sizes]
    errors = [error(mesh, wall_patches(), exact) for mesh in meshes]
    assert order(errors, [size for size, _ in sizes]) > 1.8
    assert errors[-1] < 6e-3


def test_caps_on_a_hollow_ball():
    faces = icosahedron()[:6] + 0.1 * np.random.default_rng(0).normal(size=(6, 3))
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    exact = cap_impedance(ConductingSphere(RADIUS, CONDUCTIVITY, 0.02), faces, 0.012)
    electrodes = FaceDiscs(RADIUS * faces, 0.012, CONTACT)
    sizes = [(162, 3), (642, 6)]
    meshes = [shell(sphere(RADIUS, num_points=number), 0.03, layers, outward=False) for number, layers in sizes]
    errors = [error(mesh, electrodes, exact) for mesh in meshes]
    assert order(errors, [1 / layers for _, layers in sizes]) > 1.8
    assert errors[-1] < 8e-3


def test_patches_on_a_cylinder():
    angles, heights, _ = on_wall()
    exact = wall_patch_impedance(ConductingCylinder(RADIUS, HEIGHT, CONDUCTIVITY), angles, heights, (0.03, 0.03))
    assert error(cylinder(RADIUS, HEIGHT, num_points=3000), wall_patches(), exact) < 2e-2


@pytest.mark.slow
def test_patches_on_a_cylinder_converge():
    angles, heights, _ = on_wall()
    exact = wall_patch_impedance(ConductingCylinder(RADIUS, HEIGHT, CONDUCTIVITY), angles, heights, (0.03, 0.03))
    meshes = [cylinder(RADIUS, HEIGHT, num_points=number) for number in (500, 15_000)]
    errors = [error(mesh, wall_patches(), exact) for mesh in meshes]
    assert order(errors, [mesh.num_points ** (-1 / 3) for mesh in meshes]) > 1.5
    assert errors[-1] < 4e-3


def test_patches_on_a_box():
    size, width = (0.2, 0.1, 0.06), (0.03, 0.04)
    places = np.array(
        [
            [0.05, 0.03, 0],
            [0.15, 0.07, 0.06],
            [0.12, 0.03, 0],
            [0.07, 0.07, 0.06],
            [0.04, 0.075, 0],
            [0.16, 0.025, 0.06],
        ]
    )
    exact = face_patch_impedance(size, places, width, CONDUCTIVITY)
    electrodes = FacePatches(places - [0.1, 0.05, 0], *width, CONTACT)
    sizes = (0.015, 0.0075)
    errors = [error(box(*size, cell_size=each), electrodes, exact) for each in sizes]
    assert order(errors, sizes) > 1.5
    assert errors[-1] < 1.5e-2


def test_a_box_between_plates_with_contact_impedance_is_exact():
    mesh = box(0.2, 0.1, 0.06, num_points=300)
    pattern = protocol.bipolar(2, [(0, 1)], [(0, 1)], current=1.0, driven_electrodes=True)
    for names, length, area in ((["left", "right"], 0.2, 0.006), (["bottom", "top"], 0.06, 0.02)):
        found = ForwardModel(mesh, plates(mesh, names, 0.01), pattern).voltages(0.5)
        assert abs(float(found[0])) == pytest.approx(plate_resistance(length, area, 0.5, 0.01), rel=1e-10)


def test_a_shell_of_decreasing_curvature_becomes_flat():
    """The effect of bending a thick skin decreases with 1 / R: its outer face is longer than its inner one."""
    sheet = rectangle(0.1, 0.06, num_points=150)
    nodes, pattern = NodeElectrodes([150, 170, 190, 210, 230, 250]), protocol.adjacent(6)
    flat = np.asarray(ForwardModel(layer(sheet, 0.008, 1), nodes, pattern).voltages(1.0))
    errors = []
    for radius in (1.0, 2.0, 4.0):
        bent = shell(bend(sheet, radius, axis="x"), 0.008, 1)
        errors.append(np.abs(np.asarray(ForwardModel(bent, nodes, pattern).voltages(1.0)) - flat).max())
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(2, rel=0.05)
    assert errors[2] < 5e-3 * np.abs(flat).max()
    upright = shell(bend(sheet, np.inf, axis="x"), 0.008, 1)
    voltages = ForwardModel(upright, nodes, pattern).voltages(1.0)
    np.testing.assert_allclose(voltages, flat, rtol=0, atol=1e-9 * np.abs(flat).max())


@pytest.fixture(scope="module")
def skin():
    mesh = shell(tube(0.04, HEIGHT, cell_size=0.027), 0.01, 1)
    return ForwardModel(mesh, FaceDiscs(on_wall()[2], 0.014, 0.1), protocol.adjacent(6))


@pytest.fixture(scope="module")
def of_steps(skin):
    """Voltages after steps of electrodes, nodes and conductivities, and after a step without such changes.

    One program for all three.
    """
    still = {"places": np.zeros((6, 3)), "conductivity": np.zeros(skin.mesh.num_cells)}
    still["nodes"] = np.zeros(skin.mesh.points.shape)

    def voltages(step):
        moved = eqx.tree_at(
            lambda one: [one.electrodes.position, one.mesh.points],
            skin,
            [skin.electrodes.position + step["places"], skin.mesh.points + step["nodes"]],
        )
        return moved.voltages(1.0 + step["conductivity"])

    return voltages, still


@pytest.fixture(scope="module")
def along(of_steps):
    return jax.jit(lambda step, way: jax.jvp(of_steps[0], (step,), (way,)))


WAYS = pytest.mark.parametrize(("name", "size"), [("places", 1e-3), ("conductivity", 1.0), ("nodes", 2e-4)])


@pytest.mark.slow
@WAYS
def test_derivatives_on_a_shell_by_taylor(skin, of_steps, along, name, size):
    still = of_steps[1]
    way = {**still, name: size * np.random.default_rng(1).normal(size=still[name].shape)}
    base, slope = map(np.asarray, along(still, way))
    np.testing.assert_allclose(base, skin.voltages(1.0), rtol=0, atol=1e-10 * np.abs(base).max())
    rest = []
    for step in (4e-2, 2e-2):
        there, _ = along({**still, name: step * way[name]}, still)
        rest.append(np.abs(np.asarray(there) - base - step * slope).max())
    assert rest[0] / rest[1] == pytest.approx(4, rel=0.2)


@pytest.mark.slow
@WAYS
def test_reverse_mode_on_a_shell_is_adjoint_to_forward_mode(of_steps, along, name, size):
    voltages, still = of_steps
    way = {**still, name: size * np.random.default_rng(1).normal(size=still[name].shape)}
    slope = np.asarray(along(still, way)[1])
    weights = np.random.default_rng(2).normal(size=slope.shape)
    pulled = jax.jit(jax.grad(lambda step: weights @ voltages(step)))(still)[name]
    assert weights @ slope == pytest.approx((np.asarray(pulled) * way[name]).sum(), rel=1e-9)


@pytest.mark.slow
def test_batches_on_a_shell(skin):
    values = np.exp(0.3 * np.random.default_rng(3).normal(size=(3, skin.mesh.num_cells)))
    each = np.stack([skin.voltages(one) for one in values])
    found = jax.jit(jax.vmap(skin.voltages))(values)
    np.testing.assert_allclose(found, each, rtol=0, atol=1e-10 * np.abs(each).max())
