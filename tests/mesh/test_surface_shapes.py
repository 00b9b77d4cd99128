"""Sleeves, spheres, bent sheets and shells: areas, volumes, normals, and impossible shapes."""

import jax
import numpy as np
import pytest

from jeit import protocol
from jeit.electrodes import NodeElectrodes, PointElectrodes, plates
from jeit.forward import ForwardModel
from jeit.mesh import (
    Mesh,
    Refine,
    bend,
    box,
    cap,
    centroids,
    disk,
    forearm,
    layer,
    measures,
    node_normals,
    normals,
    quality,
    rectangle,
    shell,
    sphere,
    surface_of,
    tube,
)
from jeit.mesh.mesh import facet_measures

SHEET = rectangle(0.2, 0.1, num_points=300)


def area(mesh):
    return float(np.asarray(measures(mesh)).sum())


def order(make, exact, numbers=(100, 400, 1600)):
    """The order in the edge length at which areas or volumes converge, and the last relative error."""
    meshes = [make(number) for number in numbers]
    errors = [abs(area(mesh) / exact - 1) for mesh in meshes]
    return -2 * np.polyfit(np.log([mesh.num_cells for mesh in meshes]), np.log(errors), 1)[0], errors[-1]


SMOOTH = {
    "tube": (lambda n: tube(0.04, 0.1, num_points=n), 2 * np.pi * 0.04 * 0.1),
    # A truncated cone: π (r + R) times its slant height.
    "forearm": (lambda n: forearm(0.2, 0.025, 0.045, num_points=n), np.pi * 0.07 * np.hypot(0.2, 0.02)),
    "sphere": (lambda n: sphere(0.05, num_points=n), 4 * np.pi * 0.05**2),
    "cap": (lambda n: cap(0.05, 1.0, num_points=n), 2 * np.pi * 0.05**2 * (1 - np.cos(1.0))),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_areas_and_normals_converge(name):
    make, exact = SMOOTH[name]
    found, error = order(make, exact)
    assert found == pytest.approx(2, abs=0.15)
    assert error < 2e-3
    mesh = make(800)
    assert mesh.num_points == pytest.approx(800, rel=0.06)
    assert quality(mesh).smallest_angle.min() > 30
    middle = np.asarray(centroids(mesh))
    outward = middle if name in ("sphere", "cap") else middle * [1, 1, 0]
    assert ((np.asarray(normals(mesh)) * outward).sum(axis=1) > 0).all()


@pytest.mark.parametrize("name", ["tube", "sphere", "cap"])
def test_normals_at_nodes_converge_at_second_order(name):
    errors = []
    for number in (200, 800, 3200):
        mesh = SMOOTH[name][0](number)
        exact = np.asarray(mesh.points) * ([1, 1, 0] if name == "tube" else [1, 1, 1])
        exact /= np.linalg.norm(exact, axis=1, keepdims=True)
        errors.append(np.abs(node_normals(mesh) - exact).max())
    assert errors[0] / errors[1] > 3.5
    assert errors[1] / errors[2] > 3.5
    assert errors[2] < 1e-3


def test_an_oval_sleeve():
    mesh = forearm(0.2, (0.03, 0.02), (0.05, 0.04), num_around=60)
    points = np.asarray(mesh.points)
    half = np.array([[0.03, 0.02]]) + points[:, 2:] / 0.2 * 0.02
    np.testing.assert_allclose(((points[:, :2] / half) ** 2).sum(axis=1), 1, rtol=1e-6)
    assert set(mesh.tags) == {"bottom", "top"}
    edges = np.asarray(facet_measures(mesh))[np.asarray(mesh.tags["bottom"])]
    assert edges.max() / edges.min() < 1.01


def test_normals_at_creases_are_the_mean_of_both_sides():
    cube = surface_of(box(0.1, 0.1, 0.1, cell_size=0.05))
    normal = node_normals(cube)
    corner = np.abs(np.asarray(cube.points) - [0.05, 0.05, 0.1]).max(axis=1).argmin()
    np.testing.assert_allclose(normal[corner], np.ones(3) / np.sqrt(3), atol=1e-12)


@pytest.mark.parametrize(
    ("radius", "axis", "mesh"),
    [(0.05, "x", SHEET), (-0.05, "y", SHEET), (0.05, "y", disk(0.1, num_points=200))],
    ids=["along x", "along y, upwards", "a disk"],
)
def test_bending_changes_neither_lengths_nor_voltages(radius, axis, mesh):
    flat, bent = bend(mesh, np.inf, axis=axis), bend(mesh, radius, axis=axis)
    np.testing.assert_array_equal(flat.cells, bent.cells)
    np.testing.assert_allclose(measures(bent), measures(flat), rtol=1e-9)
    np.testing.assert_allclose(area(bent), area(mesh), rtol=1e-12)
    np.testing.assert_allclose(facet_measures(bent), facet_measures(flat), rtol=1e-9)
    assert set(bent.tags) == set(mesh.tags)
    for name, index in mesh.tags.items():
        length = np.asarray(facet_measures(mesh))[index].sum()
        np.testing.assert_allclose(np.asarray(facet_measures(bent))[bent.tags[name]].sum(), length, rtol=1e-12)
    # The upper side is the outer one of a sheet that was bent down.
    up = np.asarray(normals(bent))[np.abs(np.asarray(centroids(bent))[:, :2]).sum(axis=1).argmin()]
    assert up[2] > 0.9
    assert np.sign(np.asarray(bent.points)[:, 2].min() + np.asarray(bent.points)[:, 2].max()) == -np.sign(radius)
    nodes = np.linspace(0, flat.num_points - 1, 8).astype(int)
    models = [ForwardModel(one, NodeElectrodes(nodes), protocol.adjacent(8)) for one in (flat, bent)]
    conductivity = np.exp(np.random.default_rng(0).normal(size=flat.num_cells))
    expected, found = (np.asarray(model.voltages(conductivity)) for model in models)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_a_sheet_bent_without_cuts_keeps_its_topology():
    bent = bend(SHEET, 0.05, axis="x")
    np.testing.assert_array_equal(bent.cells, SHEET.cells)
    places = np.linspace(3, SHEET.num_points - 4, 8).astype(int)
    pattern = protocol.opposite(8)
    expected = ForwardModel(SHEET, NodeElectrodes(places), pattern).voltages(0.01)
    found = ForwardModel(bent, NodeElectrodes(places), pattern).voltages(0.01)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * float(np.abs(expected).max()))
    # On the cylinder, whose axis runs along x at z = -0.05.
    np.testing.assert_allclose(np.hypot(bent.points[:, 1], bent.points[:, 2] + 0.05), 0.05, rtol=1e-12)


def test_a_closed_sleeve_differs_from_a_bent_sheet():
    """When its edges are joined, a sheet also conducts the other way round."""
    closed = tube(0.2 / (2 * np.pi), 0.1, num_around=40)
    angles = 2 * np.pi * np.arange(8) / 8
    radius = 0.2 / (2 * np.pi)
    on_tube = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(8, 0.05)], axis=1)
    on_sheet = np.stack([np.linspace(-0.1, 0.1, 8, endpoint=False) + 0.0125, np.zeros(8)], axis=1)
    pattern = protocol.adjacent(8)
    sleeve = ForwardModel(closed, PointElectrodes(on_tube), pattern).voltages(0.01)
    sheet = ForwardModel(SHEET, PointElectrodes(on_sheet), pattern).voltages(0.01)
    assert float(np.abs(sleeve - sheet).max() / np.abs(sheet).max()) > 0.3


def test_current_along_a_sleeve_obeys_ohms_law():
    """Between plates round its two ends the current density is uniform, also on oblique triangles."""
    mesh = tube(0.04, 0.1, num_around=30)
    model = ForwardModel(
        mesh,
        plates(mesh, ["bottom", "top"], 0.02),
        protocol.bipolar(2, [(0, 1)], [(0, 1)], current=1.0, driven_electrodes=True),
    )
    girth = 60 * 0.04 * np.sin(np.pi / 30)
    resistance = area(mesh) / girth**2 / 0.01 + 2 * 0.02 / girth
    found = np.abs(np.asarray(model.voltages(0.01))).max()
    assert found == pytest.approx(resistance, rel=1e-10)


SHELLS = {
    "tube": (
        lambda n: shell(tube(0.04, 0.1, num_points=n), 0.01, 2),
        np.pi * (0.05**2 - 0.04**2) * 0.1,
    ),
    "tube inward": (
        lambda n: shell(tube(0.04, 0.1, num_points=n), 0.01, 1, outward=False),
        np.pi * (0.04**2 - 0.03**2) * 0.1,
    ),
    "sphere": (
        lambda n: shell(sphere(0.05, num_points=n), 0.02, 2, outward=False),
        4 / 3 * np.pi * (0.05**3 - 0.03**3),
    ),
    "cap": (
        lambda n: shell(cap(0.05, 1.0, num_points=n), 0.01, 2),
        2 / 3 * np.pi * (1 - np.cos(1.0)) * (0.06**3 - 0.05**3),
    ),
}


@pytest.mark.parametrize(
    "name", ["tube", "sphere", *(pytest.param(name, marks=pytest.mark.slow) for name in ("tube inward", "cap"))]
)
def test_volumes_of_shells_converge(name):
    make, exact = SHELLS[name]
    found, error = order(make, exact, (200, 800, 3200))
    assert found == pytest.approx(2, abs=0.2)
    assert error < 3e-3
    mesh = make(200)
    assert set(mesh.tags) - {"bottom", "top", "edge"} == {"inner", "outer"} | (set() if name == "sphere" else {"side"})
    radius = np.linalg.norm(np.asarray(mesh.points) * ([1, 1, 0] if "tube" in name else [1, 1, 1]), axis=1)
    own = {tag: radius[np.asarray(mesh.facets)[np.asarray(mesh.tags[tag])]].mean() for tag in ("inner", "outer")}
    assert own["inner"] < own["outer"]
    assert sum(len(mesh.tags[tag]) for tag in ("inner", "outer", "side") if tag in mesh.tags) == mesh.num_facets


def test_a_shell_on_a_flat_sheet_is_a_layer():
    flat = bend(SHEET, np.inf, axis="x")
    thick, plate = shell(flat, 0.01, 2), layer(SHEET, 0.01, 2)
    np.testing.assert_allclose(thick.points, np.asarray(plate.points), atol=1e-12)
    np.testing.assert_array_equal(thick.cells, plate.cells)
    for name, other in {"inner": "bottom", "outer": "top", "side": "side"}.items():
        np.testing.assert_array_equal(thick.tags[name], plate.tags[other])
    given = shell(flat, 0.01, 2, normals=np.tile([0.0, 0.0, 1.0], (flat.num_points, 1)))
    np.testing.assert_allclose(given.points, thick.points, atol=1e-12)


def test_surface_of_a_solid():
    surface = surface_of(box(0.2, 0.1, 0.05, cell_size=0.025))
    assert surface.num_facets == 0
    assert area(surface) == pytest.approx(2 * (0.02 + 0.01 + 0.005), rel=1e-12)
    lid = surface_of(shell(tube(0.04, 0.1, num_points=200), 0.01), "outer")
    assert lid.num_points == tube(0.04, 0.1, num_points=200).num_points


@pytest.mark.parametrize("layers", [1, 3])
def test_the_largest_thickness_in_the_error_is_feasible(layers):
    """The largest thickness that an error states can be made, and a slightly larger one cannot."""
    saddle = bend(SHEET, 0.05, axis="x")
    with pytest.raises(
        ValueError, match=r"radius of curvature .* at triangle \d+, near .* It can be \S+ m thick"
    ) as caught:
        shell(saddle, 0.07, layers, outward=False)
    most = float(str(caught.value).split("It can be ")[1].split(" m")[0])
    assert most == pytest.approx(0.05, rel=0.02)
    shell(saddle, 0.99 * most, layers, outward=False)
    with pytest.raises(ValueError, match="radius of curvature"):
        shell(saddle, 1.01 * most, layers, outward=False)


def test_the_stated_thickness_is_less_than_the_refused_one():
    sleeve = tube(0.03, 0.1, cell_size=5e-3)
    with pytest.raises(ValueError, match="radius of curvature") as caught:
        shell(sleeve, 0.03, outward=False)
    shell(sleeve, float(str(caught.value).split("It can be ")[1].split(" m")[0]), outward=False)


def test_a_thickness_in_another_unit_than_the_surface():
    with pytest.raises(
        ValueError, match=r"^thickness: 3 m is more than the surface is large, 0\.1 m\. .* give 0\.003; .*scale=1e-3\)"
    ):
        shell(tube(0.03, 0.1, cell_size=5e-3), 3.0, outward=False)


def test_a_skin_that_intersects_itself():
    """A sheet rolled up one and a half times, with turns 5 mm apart."""
    flat = rectangle(0.1, 0.3, num_points=600)
    turn = (np.asarray(flat.points)[:, 1] / 0.3 + 0.5) * 3 * np.pi
    radius = 0.03 + 0.005 * turn / (2 * np.pi)
    rolled = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.asarray(flat.points)[:, 0]], axis=1)
    spiral = Mesh.create(rolled, flat.cells)
    shell(spiral, 0.004, 1)
    with pytest.raises(ValueError, match=r"0\.006 m thick grows into itself near"):
        shell(spiral, 0.006, 1)


FAULTS = {
    "bend a bent sheet": (lambda: bend(tube(0.04, 0.1), 0.05), "mesh: only a flat"),
    "bend round nothing": (lambda: bend(SHEET, 0.0), "radius: expected a length"),
    "bend along z": (lambda: bend(SHEET, 0.05, axis="z"), "axis: .*'x' or 'y'"),
    "bend in half a fold": (lambda: bend(SHEET, 0.05, num_folds=0.5), "num_folds"),
    "bend shut": (lambda: bend(SHEET, 0.03), "would overlap itself .* needs more than 0.03183"),
    "sleeve too coarse": (lambda: tube(0.04, 0.1, num_around=5), "num_around.*at least 6"),
    "sleeve of two sizes": (lambda: tube(0.04, 0.1, num_around=50, cell_size=0.01), "not two of them"),
    "wrist of three": (lambda: forearm(0.2, (0.02, 0.03, 0.04), 0.05), "wrist: give a radius"),
    "elbow of none": (lambda: forearm(0.2, 0.02, -0.05), "elbow.*positive"),
    "cap of a whole": (lambda: cap(0.05, 3.2), "angle: expected radians"),
    "shell on a plate": (lambda: shell(SHEET, 0.01), "surface: .*jeit.mesh.layer"),
    "layer on a sleeve": (lambda: layer(tube(0.04, 0.1), 0.01), "jeit.mesh.shell"),
    "shell without thickness": (lambda: shell(tube(0.04, 0.1), 0.0), "thickness.*positive"),
    "shell without layers": (lambda: shell(tube(0.04, 0.1), 0.01, 0), "num_layers"),
    "normals of a layer": (lambda: shell(tube(0.04, 0.1), 0.01, normals=np.ones((3, 3))), "normals: expected unit"),
    "normals of a solid": (lambda: normals(layer(SHEET, 0.01)), "surface_of"),
    "surface of a sheet": (lambda: surface_of(SHEET), "only solids"),
    "surface of a tag": (lambda: surface_of(layer(SHEET, 0.01), "botom"), "bottom"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults(case):
    make, match = FAULTS[case]
    with pytest.raises(ValueError, match=match):
        make()


def test_requested_local_refinement():
    fine = cap(0.05, 1.0, cell_size=0.01, refine=Refine([[0.0, 0.0]], cell_size=0.002))
    middle = np.linalg.norm(np.asarray(centroids(fine))[:, :2], axis=1)
    size = np.sqrt(np.asarray(measures(fine)))
    assert size[middle < 0.004].max() < 0.4 * size[middle > 0.03].mean()


@pytest.mark.slow
def test_voltages_of_shells_are_differentiable():
    """Of a bent layer, with respect to its nodes, by Taylor remainders."""
    import equinox as eqx

    mesh = shell(bend(rectangle(0.1, 0.05, num_points=60), 0.05, axis="x"), 0.01, 1)
    model = ForwardModel(mesh, NodeElectrodes([3, 20, 40, 55]), protocol.adjacent(4))
    way = 1e-3 * np.random.default_rng(2).normal(size=mesh.points.shape)

    def moved(step):
        return eqx.tree_at(lambda m: m.mesh.points, model, np.asarray(mesh.points) + step).voltages(1.0)

    base, slope = map(np.asarray, jax.jit(lambda way: jax.jvp(lambda size: moved(size * way), (0.0,), (1.0,)))(way))
    rest = [float(np.abs(np.asarray(moved(e * way)) - base - e * slope).max()) for e in (1e-2, 5e-3)]
    assert rest[0] / rest[1] == pytest.approx(4, rel=0.1)
    assert isinstance(mesh, Mesh)
