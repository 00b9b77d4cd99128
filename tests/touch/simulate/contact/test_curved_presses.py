"""Presses on curved skins: equal to presses on flat skins where the skins are equivalent, with the full load, at the
right place.
"""

import dataclasses

import jax
import numpy as np
import pytest

from jeit.design import Skin
from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import one_step
from jeit.layout import SurfaceLayout, spread
from jeit.mesh import Mesh, Rectangle, forearm, measures, sphere, tube
from jeit.mesh.geodesic import Geodesics, Triangles
from jeit.protocol import adjacent, two_terminal
from jeit.touch.contacts import CellFinder, find_contacts
from jeit.touch.simulate.contact import (
    BarIndenter,
    DiscIndenter,
    Foundation,
    HalfSpace,
    MovingPress,
    Press,
    PressedSkin,
    ball_indenter,
    material,
)
from jeit.touch.simulate.contact.cell_pressure import pressed_cells
from jeit.touch.simulate.contact.samples import Samples

KEY = jax.random.key(0)
STILL = dataclasses.replace(
    material("velostat"), hysteresis=0.0, creep=(), conductivity_trend=0.0, conductivity_walk=0.0, contact_trend=0.0,
    contact_walk=0.0, noise=0.0, gain_spread=0.0,
)  # fmt: skip
PLANE = Rectangle(0.1, 0.08)


def raised(points) -> np.ndarray:
    return np.column_stack([points, np.zeros(len(points))])


def rolled(mesh: Mesh, radius: float) -> Mesh:
    """A sheet rolled onto a cylinder along y that touches the sheet at the origin."""
    x, y = np.asarray(mesh.points).T
    return Mesh.create(
        np.stack([radius * np.sin(x / radius), y, radius * (np.cos(x / radius) - 1)], axis=1), mesh.cells
    )


def points_at(mesh: Mesh, nodes) -> PressedSkin:
    electrodes = PointElectrodes(np.asarray(mesh.points)[nodes])
    return PressedSkin(KEY, ForwardModel(mesh, electrodes, adjacent(len(nodes))), STILL)


def pressed(skin: PressedSkin, presses) -> np.ndarray:
    """Voltages of the model, solved anew for each press, which frames must equal."""
    found, touched = [], skin.touched(presses)
    for cells, change in zip(np.asarray(touched.cells), np.asarray(touched.change), strict=True):
        conductivity = np.array(skin.conductivity)
        np.add.at(conductivity, cells, conductivity[cells] * change)
        found.append(skin.model.voltages(conductivity))
    return np.array(found)


def test_a_slightly_bent_skin_is_equivalent_to_a_flat_one():
    flat = PLANE.mesh(num_points=300)
    wanted = np.stack(np.meshgrid([-0.03, 0, 0.03], [-0.025, 0, 0.025]), axis=-1).reshape(-1, 2)
    nodes = np.linalg.norm(np.asarray(flat.points)[:, None] - wanted, axis=-1).argmin(axis=0)
    presses = [
        (ball_indenter(0.015), 2.0, (0.0, 0.01)),
        (DiscIndenter(0.02), 5.0, (0.0, -0.015)),
        (BarIndenter(0.03, 0.004), 3.0, (0.0, 0.0)),
    ]
    exact = pressed(points_at(flat, nodes), [Press(*one, angle=0.4) for one in presses])
    change = np.abs(exact - points_at(flat, nodes).rest()).max()
    errors = []
    for radius in (0.3, 3.0, 300.0):
        bent = points_at(rolled(flat, radius), nodes)
        found = pressed(bent, [Press(shape, load, (*place, 0.0), 0.4) for shape, load, place in presses])
        errors.append(np.abs(found - exact).max() / change)
    assert errors[0] > 3 * errors[1]
    assert errors[2] < 1e-3
    in_space = points_at(Mesh.create(raised(np.asarray(flat.points)), flat.cells), nodes)
    same = pressed(in_space, [Press(one[0], one[1], (*one[2], 0.0), 0.4) for one in presses])
    np.testing.assert_allclose(same, exact, rtol=1e-9)


@pytest.mark.parametrize("kind", ["sheet", "layer", "inward"])
def test_pressures_carry_the_load(kind):
    """They are normal to the skin. Their components along the press add up to the load."""
    core = tube(0.04, 0.1, num_points=500)
    skin = Skin.create(
        SurfaceLayout.spread(core, 8, 10e-3, outward=kind != "inward"),
        thickness=4e-3,
        num_layers=0 if kind == "sheet" else 2,
    )
    samples = Samples.from_mesh(skin.model.mesh, skin.touched_face)
    surface = skin.outline
    assert isinstance(surface, Triangles)
    assert samples.area.sum() * samples.points.shape[1] == pytest.approx(surface.areas.sum(), rel=1e-9)
    middle = surface.nearest([[0.05, 0.0, 0.05], [0.0, -0.05, 0.06], [-0.05, 0.01, 0.099]]).points
    presses = [
        Press(ball_indenter(0.02), 2.0, middle[0]),
        Press(DiscIndenter(0.012), 4.0, middle[1]),
        Press(ball_indenter(0.02), 1.0, middle[2]),
    ]
    cells, pressure = pressed_cells(samples, Foundation(1e6, 4e-3), [(press,) for press in presses])
    out = surface.normals_at(surface.nearest(middle))
    along = np.einsum("ncd,nd->nc", samples.curved.cells[cells], out)
    carried = np.einsum("ncs,nc,nc->n", pressure, samples.area[cells], along)
    np.testing.assert_allclose(carried, [2.0, 4.0, 1.0], rtol=1e-12)
    whole = np.einsum("ncs,nc->n", pressure, samples.area[cells])
    np.testing.assert_allclose(whole, carried, rtol=0.03)
    assert (along[pressure.any(axis=-1)] > 0.5).all()


def test_a_ball_on_a_ball_has_a_smaller_contact_circle():
    """Winkler foundation: two balls of radii r, R have a gap ρ² / 2 (1/r + 1/R), and a⁴ = 4 W / π K (1/r + 1/R)."""
    surface = sphere(0.05, num_points=8000)
    samples, support = Samples.from_mesh(surface), Foundation(1e6, 4e-3)
    place = Triangles.of(surface).nearest([[0.02, 0.03, 0.04]]).points[0]
    cells, pressure = pressed_cells(samples, support, [(Press(ball_indenter(0.04), 2.0, place),)])
    there = samples.points[cells[0]][pressure[0] > 0]
    area = np.count_nonzero(pressure[0] > 0, axis=-1) @ samples.area[cells[0]]
    radius = (4 * 2.0 / (np.pi * support.stiffness * (1 / 0.02 + 1 / 0.05))) ** 0.25
    assert np.sqrt(area / np.pi) == pytest.approx(radius, rel=0.03)
    assert np.linalg.norm(there.mean(axis=0) / np.linalg.norm(there.mean(axis=0)) * 0.05 - place) < 1e-3


def test_a_weight_on_a_tube_rests_along_it():
    surface = tube(0.04, 0.1, num_points=8000)
    samples = Samples.from_mesh(surface)
    cells, pressure = pressed_cells(
        samples, Foundation(1e6, 4e-3), [(Press(DiscIndenter(0.02), 0.5, (0.04, 0.0, 0.05)),)]
    )
    points = samples.points[cells[0]][pressure[0] > 0]
    assert np.ptp(points[:, 2]) == pytest.approx(0.02, rel=0.1)
    assert np.ptp(points[:, 1]) < 0.8 * np.ptp(points[:, 2])
    upright, level = (
        samples.points[cells[0]][pressure[0] > 0]
        for cells, pressure in (
            pressed_cells(
                samples, Foundation(1e8, 4e-3), [(Press(BarIndenter(0.03, 0.003), 1.0, (0, 0.04, 0.05), angle),)]
            )
            for angle in (np.pi / 2, 0.0)
        )
    )
    assert np.ptp(upright[:, 2]) == pytest.approx(0.03, rel=0.1)
    assert np.ptp(level[:, 2]) < 0.004


@pytest.mark.slow
def test_a_press_on_a_tube_is_imaged_at_its_place():
    """On a radius of 40 mm, all round: within half the electrodes' pitch of 40 mm by a wide margin, 3 mm on average."""
    fine, coarse = (tube(0.04, 0.1, cell_size=size) for size in (4e-3, 5e-3))
    centres = SurfaceLayout.spread(coarse, 16, 7e-3, contact_impedance=1e-4).centres
    skins = [
        Skin.create(SurfaceLayout(centres, 7e-3, one, contact_impedance=1e-4), num_layers=0, protocol=two_terminal(16))
        for one in (fine, coarse)
    ]
    places = spread(fine, 12, margin=0.015)
    presses, skin = (
        [Press(ball_indenter(0.02), 3.0, place) for place in places],
        PressedSkin(KEY, skins[0].model, STILL),
    )
    touched, ways = skin.touched(presses), Geodesics.create(coarse)
    middles = np.asarray(fine.points)[np.asarray(fine.cells)].mean(axis=1)[np.asarray(touched.cells)]
    weight = np.asarray(touched.change) * np.asarray(measures(fine))[np.asarray(touched.cells)]
    changed = np.einsum("nc,ncd->nd", weight, middles) / weight.sum(axis=1, keepdims=True)
    changes = pressed(skin, presses) - skin.rest()
    rest = np.full(coarse.num_cells, skin.conductivity[0])
    images = np.asarray(one_step(skins[1].model, rest, noise=1e-3 * np.abs(changes).max()).image(changes))
    finder = CellFinder(coarse, sign=1)
    found = np.array([find_contacts(finder, image)[0].centroid for image in images])
    away = ways.distances(places, np.concatenate([changed, found]))
    for errors, mean, most in ((np.diag(away[:, :12]), 0.5e-3, 1e-3), (np.diag(away[:, 12:]), 4e-3, 6e-3)):
        assert errors.mean() < mean
        assert errors.max() < most


@pytest.mark.slow
def test_a_moving_press_equals_its_presses():
    arm = forearm(0.12, (0.03, 0.022), 0.04, num_points=300)
    layout = SurfaceLayout.spread(arm, 8, 12e-3, contact_impedance=1e-4)
    skin = PressedSkin(KEY, Skin.create(layout, num_layers=0).model, STILL)
    places = Triangles.of(arm).nearest([[0.04, 0, 0.04], [0.04, 0.005, 0.05], [0.035, 0.01, 0.06]]).points
    moving = MovingPress(ball_indenter(0.015), [1.0, 0.0, 2.0], places)
    record = skin.record(KEY, moving, np.array([0.0, 1.0, 2.0]))
    presses = [Press(ball_indenter(0.015), 1.0, places[0]), (), Press(ball_indenter(0.015), 2.0, places[2])]
    still = skin.frames(KEY, presses)
    np.testing.assert_allclose(record, still, rtol=1e-9)
    exact = pressed(skin, presses)
    np.testing.assert_allclose(still, exact, atol=1e-8 * np.abs(exact - skin.rest()).max())


def test_bad_presses():
    surface = tube(0.04, 0.1, num_points=700)
    curved, flat = Samples.from_mesh(surface), Samples.from_mesh(PLANE.mesh(num_points=300))
    layer, shape = Foundation(1e6, 4e-3), ball_indenter(0.02)
    for samples, place, match in (
        (curved, (0.0, 0.0), r"a press on a curved skin is at \(x, y, z\) on it.*has 2 coordinates"),
        (flat, (0.0, 0.0, 0.0), r"a press on a flat skin is at \(x, y\).*has 3 coordinates"),
        (curved, (0.0, 0.0, 0.05), r"1 of 1 presses lie off the skin, the first at \(0, 0, 50\) mm, by 3"),
    ):
        with pytest.raises(ValueError, match=match):
            pressed_cells(samples, layer, [(Press(shape, 1.0, place),)])
    with pytest.raises(ValueError, match="a HalfSpace is flat, and the skin is curved; take a Foundation"):
        pressed_cells(curved, HalfSpace(1e6), [(Press(shape, 1.0, (0.04, 0.0, 0.05)),)])
    with pytest.raises(ValueError, match=r"which presses the indenter .* into a layer 4 mm thick"):
        pressed_cells(curved, layer, [(Press(shape, 500.0, (0.04, 0.0, 0.05)),)])
    assert float(np.asarray(measures(surface)).sum()) == pytest.approx(curved.area.sum() * curved.points.shape[1])
