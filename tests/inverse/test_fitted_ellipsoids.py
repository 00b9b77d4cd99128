"""Bodies in a solid as ellipsoids, fitted with default meshes to what was solved on another mesh."""

import numpy as np
import pytest
from ball_in_a_box import BALL, BATH, RADIUS, SIZE, discs, model, sharp

from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, reconstruct
from jeit.inverse.shapes import EllipsoidPrior, reconstruct_shapes
from jeit.mesh import bisect, centroids, cut, measures
from jeit.protocol import opposite


@pytest.fixture(scope="module")
def coarse():
    return model(2500)


@pytest.mark.slow
def test_a_column_is_told_from_a_ball(coarse):
    fine, held = sharp(4000, along=2)
    change = np.asarray(fine.voltages(BATH * np.where(held, 4.0, 1.0))) - np.asarray(fine.voltages(BATH))
    noise = 0.03 * np.sqrt(np.mean(change**2))
    start = [(1, BALL + 0.005, 0.03)]
    found = reconstruct_shapes(coarse, np.asarray(coarse.voltages(BATH)) + change, BATH, start=start, noise=noise)
    (body,) = found.bodies
    assert body.column
    assert found.alternatives == (None,)
    assert np.linalg.norm((body.centroid - BALL)[:2]) < 0.002
    # What it does to the field, as of a disk in a sheet: volume times (ratio - 1) / (ratio + 1).
    strength = body.volume * np.tanh(body.contrast / 2)
    np.testing.assert_allclose(strength, np.pi * RADIUS**2 * SIZE[2] * 3 / 5, rtol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("ratios", "alike"), [((4.0, 4.0), True), ((2.0, 10.0), False)])
def test_two_balls_are_of_one_material_unless_the_data_tell_otherwise(coarse, ratios, alike):
    """Strong ones are hardly told by how much: together they are told better."""
    places, mesh = (BALL, np.array([-0.012, 0.035, 0.045])), model(5000).mesh
    balls = [lambda points, place=place: np.linalg.norm(points - place, axis=-1) - RADIUS for place in places]
    for outside in balls:

        def edge(corners, outside=outside):
            on_surface = (outside(corners).min(axis=1) < 0) & (outside(corners).max(axis=1) > 0)
            return np.where(on_surface, RADIUS / 3, np.inf)

        mesh = cut(bisect(mesh, edge), outside)
    fine = ForwardModel(mesh, discs(), opposite(16, current=1e-3))
    factor = np.ones(mesh.num_cells)
    for outside, ratio in zip(balls, ratios, strict=True):
        factor[outside(np.asarray(centroids(mesh))) < 0] = ratio
    change = np.asarray(fine.voltages(BATH * factor)) - np.asarray(fine.voltages(BATH))
    noise = 0.01 * np.sqrt(np.mean(change**2))
    frame = np.asarray(coarse.voltages(BATH)) + change
    found = reconstruct_shapes(coarse, frame, BATH, start=[(1, one + 0.004, 0.022) for one in places], noise=noise)
    order = np.argsort([body.centroid[1] for body in found.bodies])
    bodies, deviations = [found.bodies[k] for k in order], np.array(found.contrast_deviations)[order]
    assert [body.alike for body in bodies] == [alike, alike]
    off = np.abs([body.contrast for body in bodies] - np.log(ratios))
    assert np.all(off < deviations)
    assert np.all(off < 0.16)  # 16 %
    assert (bodies[0].contrast == bodies[1].contrast) == alike


@pytest.mark.slow
@pytest.mark.parametrize("kinds", ["ellipsoids", "columns"])
def test_a_kind_that_is_given_is_kept(coarse, kinds):
    """Of a column's voltages, from two starts of which one is nothing."""
    fine, held = sharp(4000, along=2)
    change = np.asarray(fine.voltages(BATH * np.where(held, 4.0, 1.0))) - np.asarray(fine.voltages(BATH))
    frame, noise = np.asarray(coarse.voltages(BATH)) + change, 0.03 * np.sqrt(np.mean(change**2))
    start, prior = [(1, BALL + 0.005, 0.03), (-1, (-0.03, 0.04, 0.03), 0.02)], EllipsoidPrior(kinds=kinds)
    found = reconstruct_shapes(coarse, frame, BATH, start=start, noise=noise, prior=prior)
    body, *others = found.bodies
    assert all(one.column == (kinds == "columns") for one in (body, *others, *found.doubtful))
    assert all(one is None for one in found.alternatives)
    assert np.linalg.norm((body.centroid - BALL)[:2]) < 0.003
    if kinds == "columns":
        assert not others
        strength = body.volume * np.tanh(body.contrast / 2)
        np.testing.assert_allclose(strength, np.pi * RADIUS**2 * SIZE[2] * 3 / 5, rtol=0.15)


@pytest.mark.slow
def test_what_a_smooth_field_explains_bends_no_body(coarse):
    """Salt that has sunk to the floor, twice as conductive there as the bath, under a ball ten times as conductive."""
    fine, held = sharp(6000)
    place = np.asarray(centroids(fine.mesh))
    sunk = np.exp(np.log(2) * np.exp(-place[:, 2] / 0.015))
    change = np.asarray(fine.voltages(BATH * np.where(held, 10.0, sunk))) - np.asarray(fine.voltages(BATH))
    noise = 0.05 * np.sqrt(np.mean(change**2))
    frame = np.asarray(coarse.voltages(BATH)) + change
    smooth = reconstruct(coarse, frame, BATH, prior=Gaussian(0.025), hyperparameter=5.0, noise=noise)
    start = [(1, BALL + 0.005, 0.025)]
    alone = reconstruct_shapes(coarse, frame, BATH, start=start, noise=noise)
    beside = reconstruct_shapes(coarse, frame, BATH, start=start, noise=noise, smooth=smooth)
    assert max(np.linalg.norm(body.centroid - BALL) for body in alone.bodies) > 0.02
    (body,) = beside.bodies
    assert np.linalg.norm(body.centroid - BALL) < 0.005
    strength = body.volume * np.expm1(body.contrast) / (np.exp(body.contrast) + 2)
    np.testing.assert_allclose(strength, 4 * np.pi / 3 * RADIUS**3 * 9 / 12, rtol=0.15)
    floor = np.asarray(centroids(coarse.mesh))[:, 2] < 0.015
    assert 1.1 < np.median(np.asarray(beside.conductivity)[floor]) / BATH < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [4.0, 0.2])
def test_a_ball_is_told_from_a_ghost_with_place_and_strength(coarse, ratio):
    fine, held = sharp(6000)
    rest, there = np.asarray(fine.voltages(BATH)), np.asarray(fine.voltages(BATH * np.where(held, ratio, 1.0)))
    change = there - rest
    noise = 0.03 * np.sqrt(np.mean(change**2))
    change = change + 0.1 * noise * np.random.default_rng(0).normal(size=change.shape)
    sign = 1 if ratio > 1 else -1
    start = [(sign, BALL + 0.008, 0.025), (-sign, (-0.03, 0.04, 0.03), 0.02)]
    found = reconstruct_shapes(coarse, np.asarray(coarse.voltages(BATH)) + change, BATH, start=start, noise=noise)
    (body,) = found.bodies
    assert body.sign == sign
    assert not body.column
    assert found.alternatives == (None,)
    assert np.linalg.norm(body.centroid - BALL) < 0.003
    # What it does to the field: volume times (ratio - 1) / (ratio + 2); which of the two is hardly told.
    strength = body.volume * np.expm1(sign * body.contrast) / (np.exp(sign * body.contrast) + 2)
    true = 4 * np.pi / 3 * RADIUS**3 * (ratio - 1) / (ratio + 2)
    np.testing.assert_allclose(strength, true, rtol=0.15)
    # The image holds all of the body, its cells by the share that it covers: harmonic means would lose a tenth of it.
    image = np.log(np.asarray(found.conductivity) / BATH / (1 + found.drift))
    np.testing.assert_allclose(np.asarray(measures(coarse.mesh)) @ image, sign * body.contrast * body.volume, rtol=0.05)
    # So does that on the finer mesh, on whose cells it ends within fewer.
    assert found.finer is not None
    fine, values = found.finer.model.mesh, np.asarray(found.finer.conductivity)
    assert fine.num_cells == len(values) > coarse.mesh.num_cells
    sharper = np.log(values / BATH / (1 + found.drift))
    np.testing.assert_allclose(np.asarray(measures(fine)) @ sharper, sign * body.contrast * body.volume, rtol=0.05)
    blurred = [
        np.asarray(measures(mesh))[np.abs(one / body.contrast * sign - 0.5) < 0.45].sum()
        for mesh, one in ((fine, sharper), (coarse.mesh, image))
    ]
    assert blurred[0] < 0.7 * blurred[1]
    assert len(found.doubtful) == 1
