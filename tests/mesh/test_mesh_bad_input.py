"""Every invalid input gives an error that names the argument and says what to do."""

import numpy as np
import pytest

from jeit.mesh import Disk, Mesh, Polygon, Rectangle, Refine, box, cylinder, disk, layer, polygon, rectangle

SQUARE = [[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]]
TWO = [[0, 1, 2], [0, 2, 3]]
CUBE = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)])
PLANE = rectangle(0.2, 0.1, num_points=20)
SOLID = layer(PLANE, 0.01)

MESHES = {
    "points of four coordinates": (lambda: Mesh.create(np.ones((5, 4)), TWO), "points.*shape"),
    "points transposed": (lambda: Mesh.create(np.ones((2, 9)), TWO), "Transpose"),
    "points that are words": (lambda: Mesh.create([["a", "b"]], TWO), "points.*real numbers"),
    "no points": (lambda: Mesh.create(np.zeros((0, 2)), TWO), "empty"),
    "NaN": (lambda: Mesh.create([[0, 0], [1, np.nan], [1, 1], [0, 1]], TWO), "NaN or infinity, first node 1"),
    "tetrahedra in the plane": (lambda: Mesh.create(SQUARE, [[0, 1, 2, 3]]), "triangles of shape"),
    "edges in space": (lambda: Mesh.create(CUBE, [[0, 1]]), "tetrahedra of shape"),
    "no cells": (lambda: Mesh.create(SQUARE, np.zeros((0, 3), int)), "m > 0"),
    "indices that are floats": (lambda: Mesh.create(SQUARE, np.array(TWO, float)), "integers"),
    "one-based indices": (lambda: Mesh.create(SQUARE, np.array(TWO) + 1), "one-based"),
    "negative indices": (lambda: Mesh.create(SQUARE, [[0, 1, 2], [0, 2, -1]]), "from -1 to 2"),
    "a node twice in a cell": (lambda: Mesh.create(SQUARE, [[0, 1, 1], [0, 2, 3]]), "uses a node twice"),
    "duplicated cells": (lambda: Mesh.create(SQUARE, [*TWO, [2, 0, 1]]), "duplicated, first cells 0 and 2"),
    "unused nodes": (lambda: Mesh.create([*SQUARE, [5, 5]], TWO), "belong to no cell, first node 4"),
    "coinciding nodes": (
        lambda: Mesh.create([*SQUARE, [0.1, 0.1], [0.0, 0.0]], [[0, 1, 2], [5, 4, 3]]),
        "coincide",
    ),
    "a flat cell": (
        lambda: Mesh.create([[0, 0], [1, 1], [2, 2], [0, 3]], [[0, 1, 2], [0, 2, 3]]),
        "no area, first cell 0",
    ),
    "a flat tetrahedron": (
        lambda: Mesh.create([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2, 3]]),
        "no volume",
    ),
    "a folded mesh": (lambda: Mesh.create([[0, 0], [1, 0], [0.8, 0.2], [0, 1]], [[0, 1, 2], [0, 1, 3]]), "overlap"),
    "three cells on an edge": (
        lambda: Mesh.create([[0, 0], [1, 0], [0.5, 1], [0.5, -1], [0.5, 2]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]]),
        "more than two cells",
    ),
    "two parts": (
        lambda: Mesh.create([*SQUARE[:3], [2, 2], [3, 2], [3, 3]], [[0, 1, 2], [3, 4, 5]]),
        "2 separate parts",
    ),
    "parts that touch in a node": (
        lambda: Mesh.create(
            [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1.2], [2, 1], [1, 2.2]],
            [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4], [3, 6, 5]],
        ),
        "separate parts",
    ),
    "tag out of range": (lambda: Mesh.create(SQUARE, TWO, tags={"side": [4]}), "'side' holds facet indices"),
    "tag inside": (lambda: Mesh.create(SQUARE, TWO, tags={"side": [[0, 2]]}), "not on the boundary"),
    "tag of floats": (lambda: Mesh.create(SQUARE, TWO, tags={"side": [0.5]}), "integers"),
    "tag of wrong shape": (lambda: Mesh.create(SQUARE, TWO, tags={"side": [[0, 1, 2]]}), "must be facet indices"),
    "empty tag": (lambda: Mesh.create(SQUARE, TWO, tags={"side": []}), "empty"),
    "tag without a name": (lambda: Mesh.create(SQUARE, TWO, tags={"": [0]}), "names"),
}

SHAPES = {
    "negative radius": (lambda: disk(-0.1), "radius.*positive"),
    "radius NaN": (lambda: Disk(float("nan")), "radius"),
    "radius of two": (lambda: Disk([0.1, 0.2]), "radius"),
    "centre of one": (lambda: disk(0.1, centre=[0.0]), "centre"),
    "no width": (lambda: rectangle(0, 0.1), "width"),
    "height infinite": (lambda: Rectangle(0.1, np.inf), "height"),
    "number and size": (lambda: disk(0.1, num_points=100, cell_size=0.1), "not both"),
    "three nodes": (lambda: disk(0.1, num_points=3), "num_points.*at least 4"),
    "half a node": (lambda: disk(0.1, num_points=100.5), "num_points.*whole"),
    "cell size 0": (lambda: rectangle(0.1, 0.1, cell_size=0.0), "cell_size.*positive"),
    "cell size in micrometres": (lambda: disk(0.1, cell_size=1e-6), "nodes; the limit"),
    "refined out of reach": (lambda: disk(0.1, cell_size=0.01, refine=Refine(cell_size=1e-7)), "nodes; the limit"),
    "too few for the strip": (lambda: rectangle(1.0, 0.01, num_points=30), "flat cells"),
    "too few for the refinement": (
        lambda: disk(0.1, num_points=100, refine=Refine(cell_size=1e-3)),
        "alone need about",
    ),
    "refine is a number": (lambda: disk(0.1, refine=[0.1]), "refine.*expected a Refine"),
    "refine without a size": (lambda: Refine([[0, 0]]), "exactly one"),
    "refine with a negative size": (lambda: Refine([[0, 0]], cell_size=-1), "cell_size"),
    "refine that coarsens": (lambda: Refine([[0, 0]], factor=0.5), "factor"),
    "refine that grows too fast": (lambda: Refine([[0, 0]], factor=2, growth=3), "growth"),
    "refine at three coordinates": (lambda: Refine([[0, 0, 0]], factor=2), "points"),
    "refine over a negative distance": (lambda: Refine(factor=2, distance=-1), "distance"),
    "size function of wrong shape": (lambda: disk(0.1, refine=lambda p: p), "one size per point"),
    "size function that vanishes": (lambda: disk(0.1, refine=lambda p: 0 * p[:, 0]), "positive and finite"),
    "boundary nodes NaN": (lambda: disk(0.1, boundary_points=[np.nan]), "boundary_points"),
    "boundary nodes on top of each other": (
        lambda: disk(0.1, boundary_points=[0.1, 0.1 + 1e-7]),
        "boundary_points.*closer",
    ),
    "two boundary nodes": (lambda: disk(0.1, num_boundary=2), "num_boundary"),
    "fewer boundary nodes than fit": (lambda: disk(0.1, num_points=2000, num_boundary=20), "num_boundary"),
    "inner nodes outside": (lambda: disk(0.1, interior_points=[[0.2, 0]]), "interior_points.*inside"),
    "inner nodes twice": (lambda: disk(0.1, interior_points=[[0, 0], [0, 0]]), "coincide"),
    "polygon of two": (lambda: polygon([[0, 0], [1, 1]]), "at least three"),
    "polygon with NaN": (lambda: Polygon([[0, 0], [1, 0], [np.nan, 1]]), "vertex 2"),
    "polygon closed twice": (lambda: Polygon([*SQUARE, SQUARE[0]]), "Do not repeat the first vertex"),
    "polygon that crosses itself": (lambda: polygon([[0, 0], [1, 1], [1, 0], [0, 1]]), "crosses or touches itself"),
    "polygon that folds back": (lambda: Polygon([[0, 0], [2, 0], [1, 0], [1, 1]]), "crosses or touches itself"),
    "hole outside": (lambda: Polygon(SQUARE, [[[1, 1], [2, 1], [2, 2]]]), r"holes\[0\].*inside"),
    "holes that overlap": (
        lambda: Polygon(
            SQUARE, [[[0.02, 0.02], [0.06, 0.02], [0.04, 0.06]], [[0.03, 0.03], [0.07, 0.03], [0.05, 0.07]]]
        ),
        r"holes\[1\].*overlaps",
    ),
    "layer of a solid": (lambda: layer(SOLID, 0.1), "plane"),
    "layer of no thickness": (lambda: layer(PLANE, 0.0), "thickness"),
    "no layers": (lambda: layer(PLANE, 0.1, 0), "num_layers"),
    "box without depth": (lambda: box(0.1, -0.1, 0.1), "depth"),
    "cylinder of no height": (lambda: cylinder(0.1, 0), "height"),
}


@pytest.mark.parametrize(("attempt", "message"), [*MESHES.values(), *SHAPES.values()], ids=[*MESHES, *SHAPES])
def test_bad_input(attempt, message):
    with pytest.raises(ValueError, match=message):
        attempt()


def test_a_boundary_that_touches_itself_is_refused():
    # A frame of eight triangles whose inner corner meets its outer boundary in one node.
    points = [[0, 0], [3, 0], [3, 3], [0, 3], [0, 1.5], [1, 1], [2, 1.5], [1, 2]]
    cells = [[0, 1, 5], [1, 6, 5], [1, 2, 6], [2, 7, 6], [2, 3, 7], [3, 4, 7], [0, 5, 4]]
    with pytest.raises(ValueError, match="touches itself at node 4"):
        Mesh.create(points, cells)
