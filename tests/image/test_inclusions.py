"""Detection of inclusions: sign, centroid and area of known bodies, and rejection of artefacts."""

import numpy as np
import pytest

from jeit.image import Inclusion, find_inclusions
from jeit.image.inclusions import StrongestRegion
from jeit.mesh import Mesh, Refine, box, centroids, disk, rectangle

MESH = disk(0.1, num_points=1500)
CENTRE = np.asarray(centroids(MESH))


def bump(x, y, width=0.015):
    return np.exp(-((CENTRE - [x, y]) ** 2).sum(axis=1) / (2 * width**2))


def test_two_bumps_of_either_sign():
    found = find_inclusions(MESH, bump(0.04, 0.02) - 0.6 * bump(-0.05, -0.01))
    assert [inclusion.kind for inclusion in found] == ["conductive", "resistive"]
    np.testing.assert_allclose(found[0].centroid, [0.04, 0.02], atol=2e-3)
    np.testing.assert_allclose(found[1].centroid, [-0.05, -0.01], atol=2e-3)
    # The half height of a Gaussian is a disc of area 2π ln 2 · width².
    assert found[0].area == pytest.approx(2 * np.pi * np.log(2) * 0.015**2, rel=0.1)
    assert found[1].peak == pytest.approx(-0.6, rel=0.05)


def test_equivalent_radius_of_a_disk_and_a_ball():
    assert Inclusion(1, (0.0, 0.0), np.pi * 0.02**2, 1.0).radius == pytest.approx(0.02)
    solid = box(0.2, 0.2, 0.2, num_points=3000)
    offset = np.linalg.norm(np.asarray(centroids(solid)) - [0.02, 0.0, 0.1], axis=1)
    (found,) = find_inclusions(solid, (offset < 0.05).astype(float))
    assert found.radius == pytest.approx(0.05, rel=0.05)


def test_touching_bumps_are_separated_but_a_shoulder_is_not():
    apart = find_inclusions(MESH, bump(0.025, 0) + 0.7 * bump(-0.025, 0))
    assert len(apart) == 2
    shoulder = find_inclusions(MESH, bump(0.012, 0) + 0.7 * bump(-0.012, 0))
    assert len(shoulder) == 1


def test_weak_peaks_and_specks_are_artefacts():
    speck = np.zeros(MESH.num_cells)
    speck[10] = 0.9
    assert len(find_inclusions(MESH, bump(0.04, 0) + 0.1 * bump(-0.04, 0) + speck)) == 1


def test_a_zero_image_has_no_inclusions():
    assert find_inclusions(MESH, np.zeros(MESH.num_cells)) == []


def test_the_strongest_region_is_that_of_the_strongest_inclusion():
    """Of either sign, beside a weaker body and a spike at the peak, in a sheet and a solid."""
    strongest = StrongestRegion(MESH)
    for sign in (1, -1):
        image = sign * (bump(0.04, 0.02) + 0.6 * bump(-0.05, -0.01)) - 0.8 * sign * bump(0.0, -0.05)
        place, peak = strongest(image)
        np.testing.assert_allclose(place, find_inclusions(MESH, image)[0].centroid, atol=1e-3)
        assert peak == pytest.approx(sign, rel=0.05)
    place, _ = strongest(bump(0.04, 0.02) + 0.8 * bump(0.052, 0.02, width=0.003))
    assert np.linalg.norm(place - [0.04, 0.02]) < 0.006
    # A faint tail to one side, below half of the peak, is no part of the region.
    place, _ = strongest(bump(0.0, 0.0) + 0.35 * bump(0.055, 0.0, width=0.02))
    assert np.linalg.norm(place) < 3e-3
    solid = box(0.2, 0.2, 0.2, num_points=2000)
    place, _ = StrongestRegion(solid)(ball(solid, [0.02, 0.0, 0.1], 0.05).astype(float))
    np.testing.assert_allclose(place, [0.02, 0.0, 0.1], atol=4e-3)
    assert np.isfinite(strongest(np.zeros(MESH.num_cells))[0]).all()


def ball(mesh, middle, radius):
    return np.linalg.norm(np.asarray(centroids(mesh)) - middle, axis=1) < radius


@pytest.mark.parametrize("refined", [False, True])
def test_volume_and_centre_of_balls_do_not_depend_on_the_mesh(refined):
    """Different cell sizes in the two halves change neither the volume nor the centre, which are weighted by volume."""
    refine = [Refine([[0.05, 0.0]], cell_size=0.006, distance=0.04)] if refined else None
    tank = box(0.17, 0.255, 0.17, cell_size=0.012, refine=refine)
    middles, radius = np.array([[0.03, -0.05, 0.1], [-0.03, 0.06, 0.06]]), 0.03
    image = 2e-3 * ball(tank, middles[0], radius) - 1e-3 * ball(tank, middles[1], radius)
    found = find_inclusions(tank, image)
    assert [one.sign for one in found] == [1, -1]
    for one, middle in zip(found, middles, strict=True):
        assert one.is_solid
        assert one.area == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.1)
        assert one.radius == pytest.approx(radius, rel=0.035)
        np.testing.assert_allclose(one.centroid, middle, atol=2e-3)


def test_only_the_inner_part_of_a_ball_at_the_wall_counts():
    tank = box(0.17, 0.255, 0.17, cell_size=0.01)
    (found,) = find_inclusions(tank, 1e-3 * ball(tank, [0.085, 0, 0.085], 0.04))
    assert found.area == pytest.approx(2 / 3 * np.pi * 0.04**3, rel=0.1)
    # The centroid of half a ball is 3/8 of its radius from the flat side.
    np.testing.assert_allclose(found.centroid, [0.085 - 0.015, 0, 0.085], atol=2e-3)


def test_a_column_in_a_solid_is_one_inclusion():
    """Tetrahedra of a ridge touch higher ones at nodes only; paths across facets had a step at every layer."""
    tank = box(0.2, 0.2, 0.2, cell_size=0.03)
    away = np.linalg.norm(np.asarray(centroids(tank))[:, :2] - [0.04, 0.02], axis=1)
    (found,) = find_inclusions(tank, -np.exp(-((away / 0.025) ** 2) / 2))
    np.testing.assert_allclose(found.centroid, [0.04, 0.02, 0.1], atol=5e-3)
    assert found.area == pytest.approx(2 * np.pi * np.log(2) * 0.025**2 * 0.2, rel=0.15)


def test_two_balls_in_a_solid_are_separated():
    tank = box(0.2, 0.2, 0.2, cell_size=0.012)
    from_middles = [np.linalg.norm(np.asarray(centroids(tank)) - [x, 0, 0.1], axis=1) for x in (-0.035, 0.035)]
    image = sum(np.exp(-((away / 0.02) ** 2) / 2) for away in from_middles)
    assert len(find_inclusions(tank, image)) == 2


def test_minimum_size_in_a_solid_is_a_ball_of_an_eighth_of_its_width():
    """A ball of a seventh of the tank's width has 0.0018 of its volume and is no artefact."""
    tank = box(0.1, 0.1, 0.1, cell_size=0.005)
    image = 1e-3 * ball(tank, [0, 0, 0.05], 0.0075)
    assert len(find_inclusions(tank, image)) == 1
    assert find_inclusions(tank, image, least_area=0.004) == []
    assert find_inclusions(tank, 1e-3 * ball(tank, [0, 0, 0.05], 0.003)) == []


def test_inclusions_on_a_surface_in_space_have_an_area():
    mesh = rectangle(0.1, 0.1, num_points=900)
    points, bend = np.asarray(mesh.points), 0.06
    rolled = np.stack([bend * np.sin(points[:, 0] / bend), points[:, 1], bend * np.cos(points[:, 0] / bend)], axis=1)
    skin = Mesh.create(rolled, mesh.cells)
    image = (np.hypot(*np.asarray(centroids(mesh)).T) < 0.02).astype(float)
    (found,) = find_inclusions(skin, image)
    (flat,) = find_inclusions(mesh, image)
    assert not found.is_solid
    assert len(found.centroid) == 3
    assert found.radius == pytest.approx(flat.radius, rel=1e-3)
