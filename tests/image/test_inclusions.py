"""Inclusions: sign, centroid and area of known blobs; artefacts left out."""

import numpy as np
import pytest

from jeit.image import Inclusion, find_inclusions
from jeit.mesh import box, centroids, disk

MESH = disk(0.1, num_points=1500)
CENTRE = np.asarray(centroids(MESH))


def bump(x, y, width=0.015):
    return np.exp(-((CENTRE - [x, y]) ** 2).sum(axis=1) / (2 * width**2))


def test_two_bumps_of_either_sign():
    found = find_inclusions(MESH, bump(0.04, 0.02) - 0.6 * bump(-0.05, -0.01))
    assert [inclusion.kind for inclusion in found] == ["conductive", "resistive"]
    np.testing.assert_allclose(found[0].centroid, [0.04, 0.02], atol=2e-3)
    np.testing.assert_allclose(found[1].centroid, [-0.05, -0.01], atol=2e-3)
    # Half height of a Gaussian bump is a disc of area 2π ln 2 · width².
    assert found[0].area == pytest.approx(2 * np.pi * np.log(2) * 0.015**2, rel=0.1)
    assert found[1].peak == pytest.approx(-0.6, rel=0.05)


def test_radius_is_that_of_a_disk_or_a_ball():
    assert Inclusion(1, (0.0, 0.0), np.pi * 0.02**2, 1.0).radius == pytest.approx(0.02)
    solid = box(0.2, 0.2, 0.2, num_points=3000)
    offset = np.linalg.norm(np.asarray(centroids(solid)) - [0.02, 0.0, 0.1], axis=1)
    (found,) = find_inclusions(solid, (offset < 0.05).astype(float))
    assert found.radius == pytest.approx(0.05, rel=0.05)


def test_touching_bumps_are_told_apart_and_a_shoulder_is_not():
    apart = find_inclusions(MESH, bump(0.025, 0) + 0.7 * bump(-0.025, 0))
    assert len(apart) == 2
    shoulder = find_inclusions(MESH, bump(0.012, 0) + 0.7 * bump(-0.012, 0))
    assert len(shoulder) == 1


def test_weak_peaks_and_specks_are_artefacts():
    speck = np.zeros(MESH.num_cells)
    speck[10] = 0.9
    assert len(find_inclusions(MESH, bump(0.04, 0) + 0.1 * bump(-0.04, 0) + speck)) == 1


def test_no_change_has_no_inclusions():
    assert find_inclusions(MESH, np.zeros(MESH.num_cells)) == []
