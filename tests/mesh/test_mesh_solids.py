"""Layers, boxes and cylinders: volumes, conformity, tags."""

import re

import numpy as np
import pytest

from jeit.electrodes import FacePatches
from jeit.electrodes.face_patches import body_mesh
from jeit.layout import ring
from jeit.mesh import Disk, Rectangle, Refine, Solid, box, cylinder, disk, layer, polygon, quality, rectangle

HOLED = polygon(
    [[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]], holes=[[[0.04, 0.04], [0.06, 0.04], [0.05, 0.06]]], cell_size=0.02
)


def volume(mesh):
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    signed = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert (signed > 0).all()
    return signed.sum()


def surface(mesh, tag=None):
    facets = np.asarray(mesh.facets)
    corners = np.asarray(mesh.points)[facets if tag is None else facets[np.asarray(mesh.tags[tag])]]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()


def euler(mesh):
    cells, facets = np.asarray(mesh.cells), np.asarray(mesh.facets)
    pairs = np.concatenate([cells[:, [i, j]] for i in range(4) for j in range(i)])
    edges = len(np.unique(np.sort(pairs, axis=1), axis=0))
    triples = np.concatenate([np.delete(cells, i, axis=1) for i in range(4)])
    faces = len(np.unique(np.sort(triples, axis=1), axis=0))
    assert 4 * len(cells) == 2 * faces - len(facets)
    return mesh.num_points - edges + faces - mesh.num_cells


@pytest.mark.parametrize("num_layers", [1, 3])
@pytest.mark.parametrize("plane", [disk(0.1, num_points=60), HOLED], ids=["disk", "with a hole"])
def test_layer(plane, num_layers):
    mesh = layer(plane, 0.03, num_layers)
    corners = np.asarray(plane.points)[np.asarray(plane.cells)]
    area = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 2
    ends = np.asarray(plane.points)[np.asarray(plane.facets)]
    perimeter = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    assert volume(mesh) == pytest.approx(0.03 * area, rel=1e-12)
    assert euler(mesh) == (0 if plane is HOLED else 1)
    assert surface(mesh, "bottom") == pytest.approx(area, rel=1e-12)
    assert surface(mesh, "top") == pytest.approx(area, rel=1e-12)
    assert surface(mesh, "side") == pytest.approx(0.03 * perimeter, rel=1e-12)
    assert mesh.num_points == (num_layers + 1) * plane.num_points
    heights = np.asarray(mesh.points)[:, 2].reshape(num_layers + 1, -1)
    np.testing.assert_allclose(heights, np.linspace(0, 0.03, num_layers + 1)[:, None] * np.ones(plane.num_points))


def test_box_has_six_tagged_faces():
    mesh = box(0.3, 0.2, 0.1, num_points=600)
    assert volume(mesh) == pytest.approx(0.006, rel=1e-12)
    assert mesh.num_points == pytest.approx(600, rel=0.15)
    faces = {"left": 0.02, "right": 0.02, "front": 0.03, "back": 0.03, "bottom": 0.06, "top": 0.06}
    for name, area in faces.items():
        assert surface(mesh, name) == pytest.approx(area, rel=1e-12)
    where = {
        "left": (0, -0.15),
        "right": (0, 0.15),
        "front": (1, -0.1),
        "back": (1, 0.1),
        "bottom": (2, 0),
        "top": (2, 0.1),
    }
    for name, (axis, value) in where.items():
        nodes = np.asarray(mesh.facets)[np.asarray(mesh.tags[name])]
        np.testing.assert_allclose(np.asarray(mesh.points)[nodes][..., axis], value, atol=1e-15)
    assert sum(len(mesh.tags[name]) for name in faces) == mesh.num_facets
    assert len(mesh.tags["side"]) == sum(len(mesh.tags[name]) for name in ("left", "right", "front", "back"))


def test_cylinder_converges_to_its_volume_with_good_cells():
    mesh = cylinder(0.1, 0.05, num_points=3000)
    assert mesh.num_points == pytest.approx(3000, rel=0.1)
    # An inscribed 66-gon is smaller by (2π²/3)/66² = 0.15 % of the area.
    assert volume(mesh) == pytest.approx(np.pi * 0.01 * 0.05, rel=2.5e-3)
    assert surface(mesh) == pytest.approx(sum(surface(mesh, name) for name in ("bottom", "top", "side")), rel=1e-12)
    # The three tetrahedra of a prism as high as it is wide have dihedral angles of 30° and more.
    assert quality(mesh).smallest_angle.min() > 25


def test_solids_use_the_refinement_of_the_plane_mesh():
    mesh = cylinder(0.1, 0.02, cell_size=0.02, num_layers=2, refine=Refine([[0.1, 0.0]], cell_size=0.002))
    assert quality(mesh).shortest_edge.min() < 0.003
    assert len(np.unique(np.asarray(mesh.points)[:, 2])) == 3


def test_tags_of_the_plane_mesh_become_tags_of_the_side():
    plane = rectangle(0.2, 0.1, num_points=30)
    mesh = layer(plane, 0.01, 1)
    assert set(mesh.tags) == {"bottom", "top", "side", "left", "right", "front", "back"}
    for tag, length in {"left": 0.1, "front": 0.2}.items():
        assert surface(mesh, tag) == pytest.approx(0.01 * length, rel=1e-12)


STRIPS = FacePatches(ring(0.15, 16, height=0.05), 0.02, 0.08, 1e-3)
TANK = Solid(Disk(0.15), 0.1)
REFINED = Refine([[0.0, 0.0]], cell_size=2e-3)
SLAB = Solid(Rectangle(0.5, 0.01), 0.01)
FEW = {
    "strips on a tank": (lambda number: body_mesh(TANK, STRIPS, number), 60),
    "a tank refined": (lambda number: TANK.mesh(num_points=number, refine=REFINED), 60),
    "a cylinder refined": (lambda number: cylinder(0.1, 0.1, num_points=number, refine=REFINED), 50),
    "a slab": (lambda number: SLAB.mesh(num_points=number), 70),
    "a long box": (lambda number: box(0.5, 0.01, 0.01, num_points=number), 70),
}


@pytest.mark.parametrize("name", FEW)
def test_error_for_too_few_nodes_states_those_of_the_solid(name):
    """It states the requested number of nodes, not that of the plane mesh, and a number that is sufficient."""
    make, few = FEW[name]
    with pytest.raises(ValueError, match=rf"^num_points: .*\b{few}\b") as caught:
        make(few)
    enough = int(re.findall("about ([0-9]+)", str(caught.value))[0])
    assert few < enough < 4000
    assert "outline" not in str(caught.value)
    assert make(round(1.2 * enough)).dimension == 3
