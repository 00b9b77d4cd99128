"""Contact integrals: exact where stated, convergent elsewhere, differentiable everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import (
    BoundaryElectrodes,
    CombinedElectrodes,
    FaceDiscs,
    FacePatches,
    FacetElectrodes,
    NodeElectrodes,
    PointElectrodes,
    SheetDiscs,
    electrodes_from_nodes,
    plates,
)
from jeit.forward import ForwardModel
from jeit.layout import grid, ring
from jeit.mesh import Mesh, box, cylinder, disk, layer, rectangle
from jeit.mesh.mesh import facet_measures
from jeit.protocol import adjacent

ROUNDING = 1e-12


def strip():
    """A 4 × 1 strip of unit squares, each divided into two triangles: every integral can be computed by hand."""
    x, y = np.meshgrid(np.arange(5.0), np.arange(2.0))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    lower = np.arange(4)
    cells = np.concatenate(
        [np.stack([lower, lower + 1, lower + 6], axis=1), np.stack([lower, lower + 6, lower + 5], axis=1)]
    )
    return Mesh.create(points, cells)


def mass_matrix(contact, num_points):
    matrix = np.zeros((num_points, num_points))
    for nodes, mass in zip(contact.nodes, contact.mass, strict=True):
        np.add.at(matrix, (np.asarray(nodes)[:, :, None], np.asarray(nodes)[:, None, :]), np.asarray(mass))
    return matrix


def test_arc_over_part_of_an_edge_by_hand():
    # Covers x from 1.25 to 1.75 of the edge from (1, 0) to (2, 0), at z = 2 ohm·m.
    contact = BoundaryElectrodes([[1.5, 0.0]], 0.5, 2.0).contact(strip())
    load = np.zeros(10)
    load[[1, 2]] = 0.25 / 2
    np.testing.assert_allclose(np.asarray(contact.load)[:, 0], load, atol=ROUNDING)
    matrix = mass_matrix(contact, 10)
    square, mixed = (0.75**3 - 0.25**3) / 3 / 2, ((0.75**2 - 0.25**2) / 2 - (0.75**3 - 0.25**3) / 3) / 2
    np.testing.assert_allclose(matrix[np.ix_([1, 2], [1, 2])], [[square, mixed], [mixed, square]], atol=ROUNDING)
    assert np.count_nonzero(np.abs(matrix) > ROUNDING) == 4


def test_arcs_may_touch_but_not_overlap():
    """Side by side on an edge, and round a corner."""
    middles = [[0.5, 0.0], [1.5, 0.0], [4.0, 0.5]]
    BoundaryElectrodes(middles, [1.0, 1.0, 3.0], 1.0).check(strip())
    BoundaryElectrodes(middles, [1.0, 1.0, 4.0], 1.0).check(strip())
    with pytest.raises(ValueError, match="Electrodes 1 and 2 overlap"):
        BoundaryElectrodes(middles, [1.0, 1.0 + 1e-6, 1.0], 1.0).check(strip())
    with pytest.raises(ValueError, match="Electrodes 2 and 3 overlap"):
        BoundaryElectrodes(middles, [1.0, 1.0, 5.0 + 1e-6], 1.0).check(strip())


def test_arc_round_a_corner_and_across_the_start_of_the_boundary():
    mesh = strip()
    for corner in ([0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [0.0, 1.0]):
        contact = BoundaryElectrodes([corner], 0.6, 1.0).contact(mesh)
        touched = np.flatnonzero(np.abs(np.asarray(contact.load)[:, 0]) > ROUNDING)
        assert len(touched) == 3
        assert float(contact.load.sum()) == pytest.approx(0.6, rel=ROUNDING)


def test_arc_on_whole_edges_equals_facet_electrode():
    mesh = disk(0.1, num_points=200)
    facets = np.asarray(mesh.facets)
    middle = np.asarray(mesh.points)[facets[3:5]].reshape(-1, 2)[1]
    lengths = np.asarray(facet_measures(mesh))[3:5]
    arc = BoundaryElectrodes([middle], lengths.sum(), 0.3).contact(mesh)
    exact = FacetElectrodes(mesh, [[3, 4]], 0.3).contact(mesh)
    # On a circle of equal edges the shared node is the middle of both edges.
    np.testing.assert_allclose(arc.load, exact.load, atol=1e-9 * float(exact.load.max()))
    np.testing.assert_allclose(
        mass_matrix(arc, mesh.num_points), mass_matrix(exact, mesh.num_points), atol=1e-9 * float(exact.load.max())
    )


@pytest.mark.parametrize(
    ("electrodes", "mesh", "area"),
    [
        (lambda m: BoundaryElectrodes(ring(0.1, 8), 0.02, 3.0), lambda: disk(0.1, num_points=300), 0.02),
        (lambda m: SheetDiscs(0.06 * ring(1.0, 5), 0.01, 3.0), lambda: disk(0.1, num_points=2000), np.pi * 1e-4),
        (
            lambda m: FacePatches(ring(0.1, 4, height=float(m.points[:, 2].mean())), 0.03, 0.03, 3.0),
            lambda: cylinder(0.1, 0.1, num_points=4000),
            9e-4,
        ),
    ],
)
def test_mass_and_load_add_up_to_area_over_impedance(electrodes, mesh, area):
    mesh = mesh()
    electrodes = electrodes(mesh)
    contact = electrodes.contact(mesh)
    per_electrode = np.asarray(contact.load).sum(axis=0)
    # Arcs are exact; windows smear the edge over half a cell, and patches bend round the wall.
    tolerance = ROUNDING if isinstance(electrodes, BoundaryElectrodes) else 0.03
    np.testing.assert_allclose(per_electrode, area / 3.0, rtol=tolerance)
    total = sum(np.asarray(mass).sum() for mass in contact.mass)
    assert total == pytest.approx(per_electrode.sum(), rel=1e-12)


# Discs and patches on faces are tested in test_curved_faces.py. Combined electrodes consist of these kinds.
SLOW = ("face discs", "patches", "combined")


@pytest.mark.parametrize(
    "kind", ["arcs", "sheet discs", "points", *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW)]
)
def test_contact_of_known_arrays_equals_that_of_traced_arrays(kind):
    """NumPy computes the one and JAX the other. Results for arrays of JAX are arrays of JAX."""
    mesh = box(0.06, 0.06, 0.01, num_points=300) if kind in ("face discs", "patches") else disk(0.05, num_points=200)
    electrodes = {
        "arcs": lambda: BoundaryElectrodes(ring(0.05, 4), 0.02, [1.0, 2.0, 3.0, 4.0]),
        "sheet discs": lambda: SheetDiscs(0.02 * ring(1.0, 4), 0.008, 2.0),
        "face discs": lambda: FaceDiscs([[0.01, 0.0, 0.01], [-0.01, 0.01, 0.0]], 0.009, 2.0),
        "patches": lambda: FacePatches([[0.01, 0.0, 0.01], [-0.01, 0.01, 0.0]], 0.011, 0.013, 2.0),
        "points": lambda: PointElectrodes([[0.013, 0.021], [-0.02, 0.01]]),
        "combined": lambda: CombinedElectrodes(
            BoundaryElectrodes(ring(0.05, 3), 0.02, 1.0), SheetDiscs([[0, 0]], 0.01, 3.0)
        ),
    }[kind]()
    values, traced = electrodes.contact(mesh), jax.jit(lambda one, on: one.contact(on))(electrodes, mesh)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(values))
    for one, other in zip(jax.tree.leaves(values), jax.tree.leaves(traced), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-14 * np.asarray(values.load).max())


def test_window_area_converges_to_the_disc():
    errors = []
    for cell_size in (0.008, 0.004, 0.002):
        mesh = rectangle(0.1, 0.1, cell_size=cell_size)
        middle = np.asarray(mesh.points).mean(axis=0) + np.array([0.0013, 0.0007])
        electrodes = SheetDiscs([middle], 0.02, 1.0)
        load = np.asarray(electrodes.contact(mesh).load)[:, 0]
        first_moment = load @ np.asarray(mesh.points) / load.sum()
        errors.append(abs(load.sum() / (np.pi * 0.02**2) - 1) + np.linalg.norm(first_moment - middle) / 0.02)
    assert errors[2] < 1e-3
    assert errors[2] < errors[0] / 8


def test_face_disc_on_a_thin_layer_stays_on_its_face():
    mesh = box(0.05, 0.05, 0.002, cell_size=0.0025)
    points = np.asarray(mesh.points)
    top = points[:, 2].max()
    middle = [*points[:, :2].mean(axis=0), top]
    load = np.asarray(FaceDiscs([middle], 0.008, 1.0).contact(mesh).load)[:, 0]
    assert load[points[:, 2] < top].sum() == 0
    assert load.sum() == pytest.approx(np.pi * 0.008**2, rel=0.02)


def test_point_electrode_interpolates():
    mesh = disk(0.1, num_points=200)
    position = np.array([[0.013, 0.021], [-0.05, 0.04]])
    load = np.asarray(PointElectrodes(position).contact(mesh).load)
    np.testing.assert_allclose(load.sum(axis=0), 1, rtol=ROUNDING)
    np.testing.assert_allclose(load.T @ np.asarray(mesh.points), position, atol=ROUNDING)


def test_point_electrode_at_a_node_equals_node_electrode():
    mesh = disk(0.1, num_points=200)
    nodes = np.array([0, 17, 60])
    at_points = PointElectrodes(mesh.points[nodes]).contact(mesh).load
    np.testing.assert_allclose(at_points, NodeElectrodes(nodes).contact(mesh).load, atol=1e-9)


def test_electrodes_from_nodes_cover_facets_between_their_nodes():
    mesh = disk(0.1, num_points=200)
    facets = np.asarray(mesh.facets)
    electrodes = electrodes_from_nodes(mesh, [facets[2:4].ravel(), facets[10]], [0.1, 0.2])
    covers = np.asarray(electrodes.covers)
    assert np.flatnonzero(covers[:, 0]).tolist() == [2, 3]
    assert np.flatnonzero(covers[:, 1]).tolist() == [10]


def test_plates_cover_tagged_faces():
    mesh = box(0.3, 0.2, 0.1, num_points=200)
    contact = plates(mesh, ["left", "top"], 0.5).contact(mesh)
    np.testing.assert_allclose(np.asarray(contact.load).sum(axis=0) * 0.5, [0.2 * 0.1, 0.3 * 0.2], rtol=ROUNDING)


def test_combined_electrodes_keep_their_order_and_impedances():
    mesh = disk(0.1, num_points=600)
    arcs, disc = BoundaryElectrodes(ring(0.1, 3), 0.02, 1e-3), SheetDiscs([[0.0, 0.0]], 0.02, 1e-4)
    both = CombinedElectrodes(arcs, disc)
    load = both.contact(mesh).load
    load = np.asarray(load)
    np.testing.assert_allclose(load[:, :3], arcs.contact(mesh).load, atol=ROUNDING)
    np.testing.assert_allclose(load[:, 3:], disc.contact(mesh).load, atol=ROUNDING)
    changed = both.with_contact_impedance([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(changed.contact_impedance, [1, 2, 3, 4])


def test_position_gradient_where_an_electrode_slides_over_corners():
    """On a disk's polygonal boundary, the middle of an electrode is often a node (offset zero)."""
    mesh, random = disk(0.1, num_points=100), np.random.default_rng(1)
    weight, direction = random.normal(size=(mesh.num_points, 4)), random.normal(size=(4, 2))

    @jax.jit
    def total(position):
        def of(position):
            return jnp.sum(BoundaryElectrodes(position, 0.03, 1.0).contact(mesh).load * weight)

        return jax.jvp(of, (position,), (direction,))

    for offset in (0.0, 0.004, 0.011):
        position, step = ring(0.1, 4, start_angle=offset / 0.1), 1e-8
        ahead, behind = (total(position + by * direction)[0] for by in (step, -step))
        assert (ahead - behind) / (2 * step) == pytest.approx(float(total(position)[1]), rel=1e-5), offset


@pytest.mark.slow
def test_single_precision_suffices_for_a_model():
    """Rounding in the covered length must not be taken for an electrode wider than the boundary."""
    with jax.enable_x64(False):
        mesh = disk(0.05, num_points=400)
        electrodes = BoundaryElectrodes(ring(0.05, 16), width=0.008, contact_impedance=0.1)
        single = ForwardModel(mesh, electrodes, adjacent(16, current=1e-3)).voltages(1e-3)
        assert single.dtype == np.float32
    mesh = disk(0.05, num_points=400)
    electrodes = BoundaryElectrodes(ring(0.05, 16), width=0.008, contact_impedance=0.1)
    double = ForwardModel(mesh, electrodes, adjacent(16, current=1e-3)).voltages(1e-3)
    np.testing.assert_allclose(single, double, rtol=2e-3)


@pytest.mark.parametrize("kind", ["sheet", "face"])
def test_electrodes_that_share_a_cell_all_contribute(kind):
    """Twelve discs, a fifth of a millimetre apart, on cells as large as themselves: each as if it were alone."""
    mesh = rectangle(0.06, 0.06, cell_size=5e-3)
    places = grid(3 * 6.2e-3, 2 * 6.2e-3, 4, 3)
    if kind == "face":
        mesh, places = layer(mesh, 5e-3, 1), np.column_stack([places, np.zeros(12)])
    discs = SheetDiscs if kind == "sheet" else FaceDiscs
    together = discs(places, 3e-3, 1e-3).contact(mesh)
    alone = [discs(place[None], 3e-3, 1e-3).contact(mesh) for place in places]
    np.testing.assert_allclose(together.load, np.hstack([one.load for one in alone]), atol=1e-12)
    np.testing.assert_allclose(together.mass[0], sum(np.asarray(one.mass[0]) for one in alone), atol=1e-12)
    cells = np.asarray(mesh.cells if kind == "sheet" else mesh.facets)
    assert ((np.asarray(together.load) > 0)[cells].any(axis=1).sum(axis=1) > 1).any()


@pytest.mark.parametrize("number", [2, 9])
def test_overlapping_discs_are_named(number):
    """Even if so many share an area that one seems to lie off the mesh."""
    with pytest.raises(ValueError, match=r"Electrodes 1 and 2 overlap by 0\.006 m"):
        SheetDiscs(np.zeros((number, 2)), 3e-3, 1e-3).check(rectangle(0.06, 0.06, cell_size=2e-3))


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([[0, 0], [0.09, 0], [0.2, 0]], r"electrode 3 at \[0.2, 0.0\] m lies outside the mesh"),
        ([[0, 0], [0.01, 0.02], [0, 0.03], [0.01, 0.02]], "Electrodes 2 and 4 are at the same position"),
    ],
)
def test_misplaced_point_electrodes_are_named(positions, message):
    with pytest.raises(ValueError, match=message):
        PointElectrodes(positions).check(disk(0.1, num_points=200))


def test_a_point_electrode_off_a_surface_is_named():
    sheet = rectangle(0.06, 0.06, cell_size=5e-3)
    points = np.asarray(sheet.points)
    bent = Mesh.create(np.column_stack([points, 0.1 * points[:, 0] ** 2]), sheet.cells)
    PointElectrodes([[0, 0, 0], [0.01, 0, 1e-5]]).check(bent)
    with pytest.raises(ValueError, match=r"electrode 2 at \[0.01, 0.0, 0.02\] m lies off the surface"):
        PointElectrodes([[0, 0, 0], [0.01, 0, 0.02]]).check(bent)
