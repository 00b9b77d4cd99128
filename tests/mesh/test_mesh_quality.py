"""Quality measures against triangles and tetrahedra of known shape."""

import numpy as np
import pytest

from jeit.mesh import Mesh, disk, quality


def test_triangles_of_known_shape():
    equilateral = quality(Mesh.create([[0, 0], [1, 0], [0.5, np.sqrt(0.75)]], [[0, 1, 2]]))
    assert equilateral.smallest_angle[0] == pytest.approx(60)
    assert equilateral.radius_ratio[0] == pytest.approx(1)
    right = quality(Mesh.create([[0, 0], [3, 0], [0, 4]], [[0, 1, 2]]))
    assert right.smallest_angle[0] == pytest.approx(np.degrees(np.arctan(0.75)))
    assert right.radius_ratio[0] == pytest.approx(2 * 1 / 2.5)
    assert (right.shortest_edge[0], right.longest_edge[0]) == (3, 5)


def test_tetrahedra_of_known_shape():
    regular = quality(Mesh.create([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], [[0, 1, 2, 3]]))
    assert regular.smallest_angle[0] == pytest.approx(np.degrees(np.arccos(1 / 3)))
    assert regular.radius_ratio[0] == pytest.approx(1)
    corner = quality(Mesh.create([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]]))
    assert corner.smallest_angle[0] == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))))
    # r = (3 − √3) / 6 and R = √3 / 2.
    assert corner.radius_ratio[0] == pytest.approx(3 * (3 - np.sqrt(3)) / 6 / (np.sqrt(3) / 2))


def test_summary_as_text():
    mesh = disk(0.1, num_points=300)
    text = repr(quality(mesh))
    assert text.startswith(f"Quality of {mesh.num_points} nodes, {mesh.num_cells} cells in 2-D: smallest angle")
    assert text.endswith(" m")
