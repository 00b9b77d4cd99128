"""Bodies in a solid as ellipsoids, fitted with default meshes to voltages solved on another mesh."""

import numpy as np
import pytest
from ball_in_a_box import BALL, BATH, RADIUS, SIZE, discs, model, sharp

from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, reconstruct
from jeit.inverse.shapes import EllipsoidPrior, reconstruct_shapes, search
from jeit.mesh import bisect, centroids, cut, measures
from jeit.protocol import opposite

PLACES = BALL, np.array([-0.012, 0.035, 0.045])  # positions of two balls


@pytest.fixture(scope="module")
def coarse():
    return model(2500)


@pytest.fixture
def one_mesh(monkeypatch):
    """Use one finer mesh where the result does not depend on their number."""
    monkeypatch.setattr(search, "_MAX_REFINEMENTS", 1)


@pytest.fixture(scope="module")
def bath(coarse):
    """Voltages of the bath alone."""
    return np.asarray(coarse.voltages(BATH))


@pytest.fixture(scope="module")
def ball():
    """A model whose mesh is cut along the ball, the mask of cells inside, and the model's voltages of the bath."""
    fine, held = sharp(6000)
    return fine, held, np.asarray(fine.voltages(BATH))


@pytest.fixture(scope="module")
def column():
    """The voltage change by a column."""
    fine, held = sharp(4000, along=2)
    return np.asarray(fine.voltages(BATH * np.where(held, 4.0, 1.0))) - np.asarray(fine.voltages(BATH))


@pytest.fixture(scope="module")
def two_balls():
    """Functions of points, negative in one ball each, and a model whose mesh is cut along both, with its voltages of
    the bath."""
    mesh = model(5000).mesh
    balls = [lambda points, place=place: np.linalg.norm(points - place, axis=-1) - RADIUS for place in PLACES]
    for outside in balls:

        def edge(corners, outside=outside):
            on_surface = (outside(corners).min(axis=1) < 0) & (outside(corners).max(axis=1) > 0)
            return np.where(on_surface, RADIUS / 3, np.inf)

        mesh = cut(bisect(mesh, edge), outside)
    fine = ForwardModel(mesh, discs(), opposite(16, current=1e-3))
    return balls, fine, np.asarray(fine.voltages(BATH))


@pytest.mark.slow
def test_a_column_is_distinguished_from_a_ball(coarse, bath, one_mesh, column):
    noise = 0.03 * np.sqrt(np.mean(column**2))
    start = [(1, BALL + 0.005, 0.03)]
    found = reconstruct_shapes(coarse, bath + column, BATH, start=start, noise=noise)
    (body,) = found.bodies
    assert body.column
    assert found.alternatives == (None,)
    assert np.linalg.norm((body.centroid - BALL)[:2]) < 0.002
    # The effect on the field, as of a disk in a sheet: volume times (ratio - 1) / (ratio + 1).
    strength = body.volume * np.tanh(body.contrast / 2)
    np.testing.assert_allclose(strength, np.pi * RADIUS**2 * SIZE[2] * 3 / 5, rtol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("ratios", "alike"), [((4.0, 4.0), True), ((2.0, 10.0), False)])
def test_two_balls_are_of_one_material_unless_the_data_contradict(coarse, bath, two_balls, ratios, alike, monkeypatch):
    """Large ratios are hard to estimate; a common one is estimated more precisely. On two finer meshes, of which one
    would not suffice."""
    monkeypatch.setattr(search, "_MAX_REFINEMENTS", 2)
    balls, fine, rest = two_balls
    mesh = fine.mesh
    factor = np.ones(mesh.num_cells)
    for outside, ratio in zip(balls, ratios, strict=True):
        factor[outside(np.asarray(centroids(mesh))) < 0] = ratio
    change = np.asarray(fine.voltages(BATH * factor)) - rest
    noise = 0.01 * np.sqrt(np.mean(change**2))
    start = [(1, one + 0.004, 0.022) for one in PLACES]
    found = reconstruct_shapes(coarse, bath + change, BATH, start=start, noise=noise)
    order = np.argsort([body.centroid[1] for body in found.bodies])
    bodies, deviations = [found.bodies[k] for k in order], np.array(found.contrast_deviations)[order]
    assert [body.alike for body in bodies] == [alike, alike]
    off = np.abs([body.contrast for body in bodies] - np.log(ratios))
    assert np.all(off < deviations)
    assert np.all(off < 0.16)  # 16 %
    assert (bodies[0].contrast == bodies[1].contrast) == alike


@pytest.mark.slow
@pytest.mark.parametrize("kinds", ["ellipsoids", "columns"])
def test_a_given_kind_is_kept(coarse, bath, one_mesh, column, kinds):
    """Voltages of a column, from two starts of which only one is at a body."""
    frame, noise = bath + column, 0.03 * np.sqrt(np.mean(column**2))
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
def test_a_smooth_field_does_not_distort_bodies(coarse, bath, ball, monkeypatch):
    """Settled salt makes the bath at the floor twice as conductive, below a ball ten times as conductive."""
    fine, held, rest = ball
    place = np.asarray(centroids(fine.mesh))
    sunk = np.exp(np.log(2) * np.exp(-place[:, 2] / 0.015))
    change = np.asarray(fine.voltages(BATH * np.where(held, 10.0, sunk))) - rest
    noise = 0.05 * np.sqrt(np.mean(change**2))
    frame = bath + change
    smooth = reconstruct(coarse, frame, BATH, prior=Gaussian(0.025), hyperparameter=5.0, noise=noise)
    start = [(1, BALL + 0.005, 0.025)]
    beside = reconstruct_shapes(coarse, frame, BATH, start=start, noise=noise, smooth=smooth)
    with monkeypatch.context() as fewer:  # one finer mesh; with more, a body is displaced as well
        fewer.setattr(search, "_MAX_REFINEMENTS", 1)
        alone = reconstruct_shapes(coarse, frame, BATH, start=start, noise=noise)
    assert max(np.linalg.norm(body.centroid - BALL) for body in alone.bodies) > 0.02
    (body,) = beside.bodies
    assert np.linalg.norm(body.centroid - BALL) < 0.005
    strength = body.volume * np.expm1(body.contrast) / (np.exp(body.contrast) + 2)
    np.testing.assert_allclose(strength, 4 * np.pi / 3 * RADIUS**3 * 9 / 12, rtol=0.15)
    floor = np.asarray(centroids(coarse.mesh))[:, 2] < 0.015
    assert 1.1 < np.median(np.asarray(beside.conductivity)[floor]) / BATH < 2.0


@pytest.mark.slow
def test_a_resistive_ball_is_distinguished_from_a_ghost(coarse, bath, ball):
    """test_ellipsoids.py tests a conductive one."""
    ratio = 0.2
    fine, held, rest = ball
    change = np.asarray(fine.voltages(BATH * np.where(held, ratio, 1.0))) - rest
    noise = 0.03 * np.sqrt(np.mean(change**2))
    change = change + 0.1 * noise * np.random.default_rng(0).normal(size=change.shape)
    sign = -1
    start = [(sign, BALL + 0.008, 0.025), (-sign, (-0.03, 0.04, 0.03), 0.02)]
    found = reconstruct_shapes(coarse, bath + change, BATH, start=start, noise=noise)
    (body,) = found.bodies
    assert body.sign == sign
    assert not body.column
    assert found.alternatives == (None,)
    assert np.linalg.norm(body.centroid - BALL) < 0.003
    # The effect on the field is volume times (ratio - 1) / (ratio + 2). The data hardly distinguish volume from ratio.
    strength = body.volume * np.expm1(sign * body.contrast) / (np.exp(sign * body.contrast) + 2)
    true = 4 * np.pi / 3 * RADIUS**3 * (ratio - 1) / (ratio + 2)
    np.testing.assert_allclose(strength, true, rtol=0.15)
    # The image contains the whole body, as cells are weighted by the covered fraction: harmonic means would lose a
    # tenth.
    image = np.log(np.asarray(found.conductivity) / BATH / (1 + found.drift))
    np.testing.assert_allclose(np.asarray(measures(coarse.mesh)) @ image, sign * body.contrast * body.volume, rtol=0.05)
    # So does the image on the finer mesh, whose edge of the body has fewer partly covered cells.
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
