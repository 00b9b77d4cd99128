"""Curved skins: the same functions as for flat skins, equal results where the skins are equivalent, and gradients
against central differences.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import linear_changes

from jeit.design import (
    Bell,
    Objective,
    Skin,
    optimise_surface_layout,
    sensitivity_map,
    skin_response,
    touch_grid,
    touches_away_from_the_edge,
)
from jeit.design.sensitivity import SensitivityMap
from jeit.design.skin.names import skin_protocol
from jeit.design.skin.sheet_touches import sheet_touches
from jeit.electrodes import FaceDiscs, SurfaceDiscs
from jeit.forward import ForwardModel
from jeit.inverse import one_step
from jeit.layout import Layout, SurfaceLayout, grid, spread
from jeit.mesh import Mesh, Rectangle, bend, box, centroids, forearm, layer, shell, tube
from jeit.mesh.geodesic import Geodesics, Triangles
from jeit.touch.contacts import CellFinder, find_contacts

SHEET = Rectangle(0.12, 0.12)


def raised(points) -> np.ndarray:
    return np.column_stack([points, np.zeros(len(points))])


@pytest.mark.slow
def test_places_are_spread_by_distance_along_the_surface():
    mesh = forearm(0.2, 0.025, 0.045, num_points=500)
    places = spread(mesh, 20, margin=0.01)
    ways = Geodesics.create(mesh)
    apart = ways.between(places)
    np.fill_diagonal(apart, np.inf)
    area = float(Triangles.of(mesh).areas.sum())
    pitch = np.sqrt(2 / np.sqrt(3) * area / 20)
    assert apart.min() > 0.65 * pitch
    assert ways.surface.distance_to_border(places).min() >= 0.0099
    np.testing.assert_array_equal(places, spread(mesh, 20, margin=0.01))
    with pytest.raises(ValueError, match="margin: 150 mm leaves no room"):
        spread(mesh, 20, margin=0.15)


def test_many_places_are_spread_over_both_faces_of_a_thin_body():
    """Faces 6 mm apart, with places about 23 mm apart on each."""
    body = box(0.2, 0.15, 0.006, cell_size=0.012)
    surface = Triangles(np.asarray(body.points), np.asarray(body.facets))
    places = spread(surface, 130)
    pitch = np.sqrt(2 / np.sqrt(3) * surface.areas.sum() / 130)
    for height in (0.0, 0.006):
        face = places[np.abs(places[:, 2] - height) < 1e-6]
        assert 50 <= len(face) <= 72
        apart = np.linalg.norm(face[:, None] - face, axis=-1)
        np.fill_diagonal(apart, np.inf)
        assert apart.min() > 0.6 * pitch


def test_94_nearest_pairs_are_nearest_along_the_surface():
    layout = SurfaceLayout.spread(tube(0.015, 0.15, num_points=500), 32, 5e-3)
    protocol = skin_protocol(layout)
    assert protocol.num_measurements == 94
    lengths = layout.lengths()
    drive = np.asarray(protocol.drive)[np.asarray(protocol.drive_index)]
    chosen = [lengths[tuple(np.flatnonzero(row))] for row in drive]
    every = np.sort(lengths[np.triu_indices(32, 1)])
    np.testing.assert_allclose(np.sort(chosen), every[:94], rtol=1e-6)
    straight = np.linalg.norm(np.asarray(layout.centres)[:, None] - layout.centres, axis=-1)
    by_chord, by_way = (set(np.argsort(one[np.triu_indices(32, 1)])[:94]) for one in (straight, lengths))
    assert by_chord != by_way


@pytest.mark.parametrize("num_layers", [0, 3])
def test_a_skin_in_a_tilted_plane_equals_the_flat_skin(num_layers):
    """And a bent skin in the limit R → ∞."""
    flat = Layout(grid(0.08, 0.08, 3, 3), 12e-3, outline=SHEET, contact_impedance=1e-4)
    plane = Skin.create(flat, num_layers=num_layers, num_points=200)
    places = np.array([[0.01, 0.02], [-0.03, 0.0], [0.02, -0.03]])
    changes = linear_changes(plane.model, float(plane.model_conductivity), plane.touched_cells(places))
    mesh = SHEET.mesh(num_points=200)
    in_space = Mesh.create(raised(np.asarray(mesh.points)), mesh.cells)
    curved = Skin.create(
        SurfaceLayout(raised(flat.centres), 12e-3, in_space, contact_impedance=1e-4), num_layers=num_layers
    )
    assert isinstance(curved.model.electrodes, FaceDiscs if num_layers else SurfaceDiscs)
    above = raised(places) + np.array([0, 0, plane.thickness if num_layers else 0.0])
    same = linear_changes(curved.model, float(curved.model_conductivity), curved.touched_cells(above))
    np.testing.assert_allclose(same, changes, rtol=1e-6, atol=1e-9 * np.abs(changes).max())


@pytest.mark.slow
def test_a_bent_skin_tends_to_the_flat_skin():
    flat = Layout(grid(0.08, 0.08, 3, 3), 8e-3, outline=SHEET, contact_impedance=1e-4)
    fine = SHEET.mesh(num_points=300)
    places = np.array([[0.01, 0.02], [-0.03, 0.0]])
    errors = []
    for radius in (0.1, 0.4, 1.6):
        surface = bend(fine, radius, axis="y")

        def rolled(points, radius=radius, up=0.0):
            angle = points[:, 0] / radius
            low = (radius + up) * np.cos(angle) - radius
            return np.column_stack([(radius + up) * np.sin(angle), points[:, 1], low])

        curved = Skin.create(SurfaceLayout(rolled(np.asarray(flat.centres)), 8e-3, surface, contact_impedance=1e-4),
                             num_layers=2, thickness=5e-3)  # fmt: skip
        found = np.asarray(curved.model.voltages(1.0))
        cells = Mesh.create(np.column_stack([unbent(surface, radius), np.zeros(surface.num_points)]), surface.cells)
        plane = Skin.create(SurfaceLayout(raised(np.asarray(flat.centres)), 8e-3, cells, contact_impedance=1e-4),
                            num_layers=2, thickness=5e-3)  # fmt: skip
        exact = np.asarray(plane.model.voltages(1.0))
        errors.append(np.abs(found / exact - 1).max())
        if radius == 0.1:
            touched = curved.touched_cells(rolled(places, up=5e-3), Bell(2.5e-3, 7.5e-3))
            assert np.isfinite(np.asarray(curved.voltage_changes(touched))).all()
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 0.005


def unbent(surface: Mesh, radius: float) -> np.ndarray:
    points = np.asarray(surface.points)
    return np.column_stack([radius * np.arctan2(points[:, 0], radius + points[:, 2]), points[:, 1]])


@pytest.fixture(scope="module")
def bent_and_flat() -> tuple[Mesh, Mesh]:
    """A bent sheet and the flat one with the same cells: `bend` preserves all lengths on the sheet."""
    fine = SHEET.mesh(num_points=400)
    return bend(fine, 0.03), bend(fine, np.inf)


def on_bent(surface: Mesh, flat: Mesh, points) -> np.ndarray:
    """Points (n, 3) of the bent sheet, from points (n, 2) of the flat one."""
    at = Triangles.of(flat).nearest(raised(points))
    return np.einsum("pk,pkd->pd", at.weights, np.asarray(surface.points)[np.asarray(surface.cells)[at.triangle]])


def test_a_bent_sheet_without_thickness_equals_the_flat_sheet(bent_and_flat):
    """Discs are measured along the sheet."""
    surface, flat = bent_and_flat
    centres = grid(0.08, 0.08, 3, 3)
    bent = on_bent(surface, flat, centres)
    voltages = [
        np.asarray(Skin.create(SurfaceLayout(one, 8e-3, mesh), num_layers=0).model.voltages(0.01))
        for one, mesh in ((raised(centres), flat), (bent, surface))
    ]
    np.testing.assert_allclose(voltages[1], voltages[0], rtol=1e-10)


def test_touches_of_a_bent_sheet_and_their_derivatives_are_those_of_the_flat_sheet(bent_and_flat):
    """The tangential directions are not specified: products of derivatives do not depend on them."""
    surface, flat = bent_and_flat
    bent = on_bent(surface, flat, [[0.01, 0.02]])
    depth, deviation, thickness, contrast = 2e-3, 12e-3, 0.01, 3.0
    touches = sheet_touches(surface, Bell(depth, deviation), bent, thickness=thickness, contrast=contrast)
    used = np.flatnonzero(np.asarray(touches.touched.change)[0])
    assert len(used) > 100
    cells, change = (np.asarray(one)[0, used] for one in (touches.touched.cells, touches.touched.change))
    slope = np.asarray(touches.slope)[0, used]
    apart = np.asarray(centroids(flat))[cells, :2] - [0.01, 0.02]
    expected = (contrast - 1) * depth / thickness * np.exp(-np.sum(apart**2, axis=1) / (2 * deviation**2))
    np.testing.assert_allclose(change, expected, rtol=1e-9)
    expected_slope = expected[:, None] * apart / deviation**2
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), np.linalg.norm(expected_slope, axis=1), rtol=1e-9)
    products, expected_products = slope @ slope.T, expected_slope @ expected_slope.T
    np.testing.assert_allclose(products, expected_products, rtol=0, atol=0.05 * expected_products.max())
    thicker = touches.with_thickness(2 * thickness)
    np.testing.assert_allclose(thicker.touched.change, np.asarray(touches.touched.change) / 2, rtol=1e-12)
    np.testing.assert_allclose(thicker.slope, np.asarray(touches.slope) / 2, rtol=1e-12)


@pytest.fixture(scope="module")
def around() -> Skin:
    """A sheet around a tube."""
    layout = SurfaceLayout.spread(tube(0.03, 0.1, num_points=200), 8, 12e-3, contact_impedance=1e-4)
    return Skin.create(layout, num_layers=0)


def test_places_are_on_the_surface(around):
    places = touches_away_from_the_edge(around.outline, 0.015, 4, 4)
    assert places.places.shape == (16, 3)
    with pytest.raises(ValueError, match="no raster"):
        SensitivityMap(places, np.ones((16, 3))).image()
    with pytest.raises(ValueError, match="lie off the skin's surface"):
        around.touched_cells([[0.0, 0.0, 0.05]])
    with pytest.raises(ValueError, match=r"places must be \(n, 3\)"):
        around.touched_cells([[0.0, 0.0]])


@pytest.mark.slow
def test_the_same_calls_as_on_flat_skins(around):
    skin, places = around, touches_away_from_the_edge(around.outline, 0.015, 4, 4)
    mapped = sensitivity_map(skin.model, skin.model_conductivity, places, thickness=skin.thickness)
    assert float(mapped.minimum) > 0
    assert float(mapped.uniformity) > 0.5
    response = skin_response(skin, places, key=jax.random.key(0), num_taxels=4)
    assert response.taxels.positions.shape == (4, 3)
    assert float(response.taxels.areas.sum()) > 0


def test_touches_are_below_the_surface_at_their_distance_along_it():
    core = tube(0.03, 0.1, num_points=700)
    skin = Skin.create(SurfaceLayout.spread(core, 8, 8e-3), thickness=8e-3, num_layers=5)
    place = np.array([[0.038, 0.0, 0.05]])
    touched = skin.touched_cells(place, Bell(4e-3, 8e-3))
    changed = np.unique(np.asarray(touched.cells)[np.asarray(touched.change) != 0])
    mesh = skin.model.mesh
    middle = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    radius, angle = np.hypot(middle[:, 0], middle[:, 1]), np.arctan2(middle[:, 1], middle[:, 0])
    depth = 4e-3 * np.exp(-((0.038 * angle) ** 2 + (middle[:, 2] - 0.05) ** 2) / (2 * 8e-3**2))
    inside = np.flatnonzero(0.038 - radius < depth)
    assert len(set(changed) ^ set(inside)) < 0.1 * len(inside)


def tangential(layout: SurfaceLayout, surface: Mesh) -> np.ndarray:
    """A random step of each electrode along the surface."""
    triangles = Triangles.of(surface)
    normal = triangles.normals_at(triangles.nearest(layout.centres))
    step = np.random.default_rng(0).normal(size=normal.shape)
    return step - (step * normal).sum(axis=1, keepdims=True) * normal


@pytest.mark.slow
@pytest.mark.parametrize("num_layers", [0, 1], ids=["sheet", "layer"])
def test_positions_along_the_surface_have_gradients(num_layers):
    """Gradients of weighted sums of the voltages, against central differences."""
    surface = tube(0.03, 0.08, num_points=100)
    layout = SurfaceLayout.spread(surface, 4, 20e-3, contact_impedance=1e-4)
    model, step = Skin.create(layout, num_layers=num_layers, thickness=6e-3).model, tangential(layout, surface)

    def voltages(position):
        electrodes = eqx.tree_at(lambda each: each.position, model.electrodes, position)
        return model.with_electrodes(electrodes).voltages(1.0)

    at, draw = np.asarray(model.electrodes.position), np.random.default_rng(1)
    gradient = jax.jit(lambda position, weights: jax.vjp(voltages, position)[1](weights)[0])
    for size in (1e-6, 1e-7):
        change = (np.asarray(voltages(at + size * step)) - np.asarray(voltages(at - size * step))) / (2 * size)
        for weights in draw.normal(size=(3, len(change))):
            slope = np.sum(np.asarray(gradient(at, weights)) * step)
            assert np.abs(weights @ change - slope) < 1e-4 * np.linalg.norm(weights) * np.linalg.norm(change)


@pytest.mark.parametrize("num_layers", [0, 1], ids=["sheet", "layer"])
def test_loads_of_electrodes_along_the_surface_have_gradients(num_layers):
    """Gradients with respect to the electrodes' load vectors, through which alone voltages depend on them, against
    central differences.
    """
    surface = tube(0.03, 0.08, num_points=100)
    layout = SurfaceLayout.spread(surface, 4, 20e-3, contact_impedance=1e-4)
    model, step = Skin.create(layout, num_layers=num_layers, thickness=6e-3).model, tangential(layout, surface)

    def loads(position):
        return eqx.tree_at(lambda each: each.position, model.electrodes, position).contact(model.mesh).load

    at = np.asarray(model.electrodes.position)
    slope = np.asarray(jax.jit(lambda at, step: jax.jvp(loads, (at,), (step,))[1])(at, step))
    for size in (1e-6, 1e-7):
        change = (np.asarray(loads(at + size * step)) - np.asarray(loads(at - size * step))) / (2 * size)
        assert np.abs(change - slope).max() < 1e-4 * np.abs(slope).max()


@pytest.mark.slow
def test_optimises_electrodes_along_the_surface():
    surface = tube(0.03, 0.08, num_points=250)
    crowded = spread(surface, 8, margin=0.02)
    skin = Skin.create(SurfaceLayout(crowded, 8e-3, surface, contact_impedance=1e-4), num_layers=0)
    places = touch_grid(skin.outline, 5, 5).places
    objective = Objective.create(skin, places, correlation=0.02)
    found = optimise_surface_layout(skin, objective, steps=4, minimum_spacing=0.012)
    assert found.value > found.start_value + 0.02
    assert (np.diff(found.history) > 0).all()
    assert Triangles.of(surface).nearest(found.layout.centres).away.max() < 1e-9
    with pytest.raises(ValueError, match="must be a curved sheet"):
        optimise_surface_layout(Skin.create(Layout(grid(0.08, 0.08, 3, 3), 8e-3, outline=SHEET)), objective)


def mean_error(fine: Skin, coarse: Skin, places, far) -> float:
    changes = np.asarray(fine.voltage_changes(fine.touched_cells(places, Bell(4e-3, 6e-3))))
    changes = changes + np.random.default_rng(7).normal(scale=2e-5, size=changes.shape)
    images = np.asarray(one_step(coarse.model, coarse.model_conductivity, noise=2e-5).image(jnp.asarray(changes)))
    finder = CellFinder(coarse.model.mesh, sign=-1)
    return float(np.mean([far(place, find_contacts(finder, one)[0].centroid)
                          for place, one in zip(places, images, strict=True)]))  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.03, 0.04])
def test_touches_are_located_as_accurately_as_on_the_flat_skin(radius):
    """`TOUCH` H: the geodesic error is at most 1.5 times that of the flat skin with the same sides."""
    height = 0.14
    sides = Rectangle(2 * np.pi * radius, height)
    even = Layout(grid(0.75 * 2 * np.pi * radius, 0.75 * height, 4, 4), 6e-3, outline=sides)
    flat = [Skin.create(even, num_layers=0, cell_size=size) for size in (3.5e-3, 5e-3)]
    inside = touches_away_from_the_edge(sides, 0.015, 8, 8).places
    plane = mean_error(*flat, inside, lambda one, other: np.linalg.norm(one - other))
    centres = SurfaceLayout.spread(tube(radius, height, cell_size=5e-3), 16, 6e-3, margin=5e-3).centres
    curved = [
        Skin.create(SurfaceLayout(centres, 6e-3, tube(radius, height, cell_size=size)), num_layers=0)
        for size in (3.5e-3, 5e-3)
    ]
    on = touches_away_from_the_edge(curved[0].outline, 0.015, 6, 8).places
    ways = Geodesics.create(curved[1].model.mesh)
    error = mean_error(*curved, on, lambda one, other: ways.distances(one[None], other[None])[0, 0])
    assert error < 1.5 * plane
    assert error < 0.008


def test_a_touch_across_the_seam_is_one_touch():
    surface = tube(0.03, 0.1, cell_size=8e-3)
    skin = Skin.create(SurfaceLayout.spread(surface, 12, 9e-3), num_layers=0)
    touched = skin.touched_cells([[-0.03, 0.0, 0.05]], Bell(4e-3, 7e-3))
    (changes,) = linear_changes(skin.model, float(skin.model_conductivity), touched)
    image = np.asarray(one_step(skin.model, skin.model_conductivity).image(changes))
    (contact, *_) = find_contacts(CellFinder(surface, sign=-1), image)
    assert np.linalg.norm(contact.centroid - [-0.03, 0, 0.05]) < 0.008


@pytest.mark.parametrize(
    ("match", "centres", "diameter"),
    [
        (
            r"electrode 1, 6 mm across at \(50, 0, 50\) mm, is 20\.\d mm off the surface, farther than its radius",
            [[0.05, 0, 0.05]],
            6e-3,
        ),
        (
            r"electrode 1, 6 mm across at \(30, 0, 0\.5\) mm, lies on the surface's edge, 0\.5 mm from it",
            [[0.03, 0, 0.0005]],
            6e-3,
        ),
        (r"electrode 1 \('1'\) and electrode 2 \('2'\) overlap by 3 mm", [[0.03, 0, 0.05], [0.03, 0, 0.053]], 6e-3),
        ("larger than the surface's radius of curvature", [[0.03, 0, 0.05]], 8e-2),
    ],
)
def test_refuses_bad_electrodes(match, centres, diameter):
    with pytest.raises(ValueError, match=match):
        SurfaceLayout(centres, diameter, tube(0.03, 0.1, num_points=1500))


@pytest.mark.parametrize(("scale", "message"), [(100.0, "would be 10 m across"), (8e-3, "would be 0.8 mm across")])
def test_the_size_of_a_surface_is_that_of_its_longest_side(scale, message):
    """Wherever the surface is; the sides are 100, 60 and 60 mm long."""
    surface, far = tube(0.03, 0.1, num_points=200), np.array([200.0, -30.0, 7.0])
    centres = np.array([[0.03, 0, 0.05]])
    moved = eqx.tree_at(lambda one: one.points, surface, surface.points + far)
    assert SurfaceLayout(centres + far, 6e-3, moved).num_electrodes == 1
    scaled = eqx.tree_at(lambda one: one.points, surface, scale * surface.points)
    with pytest.raises(ValueError, match=message):
        SurfaceLayout(scale * centres, 6e-3 * scale, scaled)


def test_refuses_bad_skins():
    layout = SurfaceLayout.spread(tube(0.03, 0.1, num_points=300), 8, 9e-3, outward=False)
    with pytest.raises(ValueError, match="cell_size and num_points are of flat skins"):
        Skin.create(layout, cell_size=0.005)
    with pytest.raises(ValueError, match="thick"):
        Skin.create(layout, thickness=0.035, num_layers=3)
    with pytest.raises(ValueError, match="surface is flat or a solid"):
        SurfaceLayout([[0.03, 0, 0.05]], 6e-3, layer(SHEET.mesh(num_points=200), 5e-3, 1))
    discs, protocol, solid = (
        SurfaceDiscs(layout.centres, 3.5e-3, 1e-4),
        skin_protocol(layout),
        shell(layout.surface, 5e-3),
    )
    with pytest.raises(ValueError, match="SurfaceDiscs need a mesh that is a surface in space"):
        ForwardModel(solid, discs, protocol)
    inward = Skin.create(layout, thickness=6e-3, num_layers=3)
    assert inward.touched_face == "inner"
    assert float(np.hypot(*inward.outline.points[:, :2].T).max()) < 0.0245
