"""Bodies in a solid as ellipsoids: derivatives, geometry, and estimates in a box solved on another mesh."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ball_in_a_box import BALL, BATH, RADIUS, SIZE, discs, model, shape_problem, sharp

from jeit.electrodes import CombinedElectrodes, plates
from jeit.forward import ForwardModel
from jeit.forward.changes import solved_fields
from jeit.inverse import Gaussian, TotalVariation, reconstruct
from jeit.inverse.nonlinear.problem import independent_data
from jeit.inverse.shapes import (
    Accuracy,
    EllipsoidPrior,
    Quantities,
    StarPrior,
    alternatives,
    finer_mesh,
    number_and_kinds,
    problem,
    quantities,
    reconstruct_shapes,
    search,
)
from jeit.inverse.shapes.bodies import Bodies
from jeit.inverse.shapes.ellipsoid import Ellipsoids
from jeit.inverse.shapes.finer_mesh import refine_at_surfaces
from jeit.inverse.shapes.problem import ShapeFit, ShapeProblem
from jeit.mesh import box, measures
from jeit.protocol import opposite

# Placeholder for the rows of fits, which these tests do not use.
ROWS: Any = None


@pytest.fixture(scope="module")
def coarse():
    return model(1200)


@pytest.fixture(scope="module")
def fine():
    """A model whose mesh is cut along the ball, the mask of cells inside, and the model's voltages of the bath."""
    cut_along, held = sharp(4000)
    return cut_along, held, np.asarray(cut_along.voltages(BATH))


@pytest.fixture
def ellipsoids(coarse):
    start = [[0.01, 0.02, 0.05], [-0.01, 0.0, 0.06], [0.01, 0.01, 0.04]]
    return Ellipsoids.create(coarse.mesh, EllipsoidPrior(), start, [1, -1, 1])


def test_derivatives_equal_finite_differences(ellipsoids, coarse):
    rng = np.random.default_rng(0)
    point = ellipsoids.of_radii([0.03, 0.02, 0.03]) + 0.3 * rng.normal(size=31)
    ellipsoids, point = ellipsoids.with_other_kind([2], point)
    along, step = rng.normal(size=31), 1e-6
    here = ellipsoids.image(point)
    ahead, behind = ellipsoids.image(point + step * along), ellipsoids.image(point - step * along)
    change = np.zeros(coarse.mesh.num_cells)
    for (cells, slope), part in zip(here.slopes, np.split(along, [1, 11, 21]), strict=True):
        change[cells] += slope @ part
    np.testing.assert_allclose(change, (ahead.image - behind.image) / (2 * step), rtol=1e-6, atol=1e-6)
    assert here.overlap.min() > 1e-5
    np.testing.assert_allclose(here.overlap_slope @ along, (ahead.overlap - behind.overlap) / (2 * step), rtol=1e-5)
    for k in range(3):
        by_differences = Bodies.centroid_slope(ellipsoids, k, point, np.full(10, 1e-5))
        np.testing.assert_allclose(ellipsoids.centroid_slope(k, point, None), by_differences, atol=1e-7)


def test_the_contrast_is_explored_once_for_each_material(ellipsoids, monkeypatch):
    same, point = ellipsoids.of_one_material(1, ellipsoids.of_radii([0.03, 0.02, 0.03]))
    assert same.first.tolist() == [0, 1, 0]
    explored = []

    def explore(problem, fit, k):
        explored.append(k)
        return [f"material of body {k}"]

    def quantify(problem, explored, k, unmodelled, accuracy):
        return Quantities(k, explored[0], unmodelled, (None, None), 0.0, (0.0, 0.0))

    monkeypatch.setattr(quantities, "explore_contrast", explore)
    monkeypatch.setattr(quantities, "quantify", quantify)
    monkeypatch.setattr(quantities, "centroid_radius", lambda *_: 0.0)
    problem: Any = SimpleNamespace(
        fit=lambda bodies, coefficients, steps: ShapeFit(bodies, coefficients, 1.0, ROWS), misfit=lambda fit: 0.9
    )
    fit = ShapeFit(same, point, 1.0, ROWS)
    found = quantities.with_quantities(problem, fit, Accuracy(np.ones(3)), [0.1, 0.2, 0.3], [2, 0, 1])  # pyright: ignore
    materials = [(one.change, one.change_interval, one.measure) for one in found]
    assert materials == [(2, "material of body 0", 0.3), (0, "material of body 0", 0.1), (1, "material of body 1", 0.2)]
    assert explored == [0, 1]


def test_bodies_of_one_material_have_the_contrast_of_the_first(ellipsoids, coarse):
    rng = np.random.default_rng(4)
    point = ellipsoids.of_radii([0.03, 0.02, 0.03]) + 0.3 * rng.normal(size=31)
    same, point = ellipsoids.of_one_material(1, point)
    assert same.same_material.tolist() == [True, False, True]
    assert [same.body(k, point).alike for k in range(3)] == [True, False, True]
    moved = point + rng.normal(size=31)
    bodies = [same.body(k, moved) for k in range(3)]
    assert bodies[0].contrast == bodies[2].contrast != bodies[1].contrast
    assert same.on(coarse.mesh).body(2, moved).contrast == bodies[0].contrast
    for k, row in enumerate(same.rows(moved)):
        np.testing.assert_array_equal(moved[list(quantities._radius_and_contrast_index(same, k))], row[3:5])
    np.testing.assert_allclose(same.odds, -np.log(EllipsoidPrior().odds_for_one_material))
    alone, rest = same.without(0, moved)
    assert not alone.body(1, rest).alike
    assert alone.body(1, rest).contrast == bodies[2].contrast
    assert alone.odds == 0
    problem, along, step = shape_problem(coarse), rng.normal(size=31), 1e-6
    (_, jacobian, _, _) = problem.linearise(point, same)
    ahead, behind = (problem.linearise(point + side * step * along, same)[0] for side in (1, -1))
    np.testing.assert_allclose(jacobian() @ along, (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-3)


def test_bodies_keep_their_effect_when_they_become_one_material(ellipsoids):
    """The effect is volume times (ρ - 1) / (ρ + 2), of a column (ρ - 1) / (ρ + 1)."""
    point = ellipsoids.of_radii([0.02, 0.02, 0.02])
    point[[5, 25]] = 0.6, -0.6  # contrasts of the first and the last
    ellipsoids, point = ellipsoids.with_other_kind([2], point)
    same, after = ellipsoids.of_one_material(1, point)

    def effect(bodies, values, k, ends):
        body, row = bodies.body(k, values), bodies.rows(values)[k]
        size = np.exp((1 + ends) * bodies.log_radius(row))
        return size * np.expm1(body.contrast) / (np.exp(body.contrast) + ends)

    for k, ends in ((0, 2), (2, 1)):
        np.testing.assert_allclose(effect(ellipsoids, point, k, ends), effect(same, after, k, ends))
    # So do they when the contrast of their material is explored; the other material keeps its own.
    problem: Any = SimpleNamespace(
        fit=lambda bodies, start, *_: ShapeFit(bodies, start, 1.0, ROWS), negative_log_evidence=lambda fit: 7.0
    )
    last = np.log(same.body(2, after).contrast)
    for log_contrast in (last - 0.5, last + 1.0):
        explored = quantities._fit_with_fixed_contrast(problem, same, after, 2, last, log_contrast)
        fit = explored.fit
        assert (explored.log_contrast, explored.negative_log_likelihood) == (log_contrast, 7.0)
        for k, ends in ((0, 2), (2, 1)):
            assert fit.bodies.body(k, fit.coefficients).contrast == pytest.approx(np.exp(log_contrast))
            np.testing.assert_allclose(effect(fit.bodies, fit.coefficients, k, ends), effect(same, after, k, ends))
        np.testing.assert_array_equal(fit.bodies.rows(fit.coefficients)[1], same.rows(after)[1])
        assert fit.bodies.body(1, fit.coefficients).contrast == same.body(1, after).contrast


def test_the_kind_of_bodies_can_be_given(coarse):
    with pytest.raises(ValueError, match=r"kinds must be one of either, ellipsoids, columns; .* mean 'columns'"):
        EllipsoidPrior(kinds="colums")
    bodies = Ellipsoids.create(coarse.mesh, EllipsoidPrior(kinds="columns"), [[0.0, 0.0, 0.05]], [1])
    columns, point = bodies.with_other_kind([0], bodies.of_radii([RADIUS]))
    assert columns.odds == 0
    problem: Any = None
    result = number_and_kinds.SearchResult(ShapeFit(bodies, point, 1.0, ROWS), [9.0], ())  # pyright: ignore
    assert number_and_kinds.alternative_fits(problem, result)[1] is None
    assert alternatives.alternatives(problem, ShapeFit(columns, point, 1.0, ROWS)) == [
        (None, pytest.approx(np.nan, nan_ok=True))
    ]


@pytest.mark.parametrize(("worse", "decided"), [(3.0, False), (5.0, True)])
def test_the_deviation_of_a_common_contrast_includes_that_of_separate_ones(ellipsoids, worse, decided):
    same, point = ellipsoids.of_one_material(1, ellipsoids.of_radii([0.02, 0.02, 0.02]))
    spread, contrast = EllipsoidPrior().contrast_spread, EllipsoidPrior().contrast

    class Evidence:
        """Separate contrasts are `worse`, have three times the deviation, and the last is twice the common one."""

        def negative_log_evidence(self, fit):
            return fit.bodies.odds + (0.0 if fit.bodies.same_material.any() else worse)

        def deviations(self, fit):
            return np.full(len(fit.coefficients), 0.1 if fit.bodies.same_material.any() else 0.3)

    problem: Any = Evidence()
    moved = point.copy()
    moved[25] = np.log(2) / spread
    one, each = ShapeFit(same, point, 1.0, ROWS), ShapeFit(ellipsoids, moved, 1.0, ROWS)
    found = alternatives.contrast_deviations(problem, one, each)
    slope = spread * contrast
    wide = [0.3 * slope, 0.3 * slope, contrast + 0.3 * 2 * slope]
    np.testing.assert_allclose(found, np.hypot([0.1 * slope] * 3 if decided else wide, 0.1))


def test_volume_centroid_and_interior_of_an_ellipsoid(ellipsoids):
    rng = np.random.default_rng(1)
    point = ellipsoids.of_radii([0.02, 0.02, 0.02])
    point[6:11] = 0.8 * rng.normal(size=5)  # stretches of the first body
    body = ellipsoids.body(0, point)
    length = np.linalg.norm(body.axes, axis=1)
    assert np.all(np.diff(length) < 0)
    np.testing.assert_allclose(body.axes @ body.axes.T, np.diag(length**2), atol=1e-12)
    np.testing.assert_allclose(np.prod(length), 0.02**3, rtol=1e-9)
    np.testing.assert_allclose(body.volume, 4 * np.pi / 3 * 0.02**3, rtol=0.03)  # sampled in cells a third as large
    np.testing.assert_allclose(body.centroid, body.centre, atol=5e-4)
    ends = np.concatenate([body.centre + 0.99 * body.axes, body.centre - 0.99 * body.axes])
    assert body.holds(ends).all()
    assert not body.holds(body.centre + 1.01 * body.axes).any()


def test_a_column_extends_through_the_whole_height(ellipsoids):
    point = ellipsoids.of_radii([0.02, 0.02, 0.02])
    point[[4, 6, 7, 8, 9]] = [1.0, 0.8, 0.5, -0.6, 0.3]  # radius and stretches of the first body
    before = ellipsoids.body(0, point).volume
    columns, point = ellipsoids.with_other_kind([0], point)
    body = columns.body(0, point)
    assert body.column
    np.testing.assert_allclose(body.volume, before, rtol=0.03)
    length = np.linalg.norm(body.axes, axis=1)
    np.testing.assert_allclose(body.axes[0], [0, 0, np.copysign(SIZE[2] / 2, body.axes[0, 2])], atol=1e-12)
    np.testing.assert_allclose(np.pi * length[1] * length[2] * SIZE[2], body.volume, rtol=0.03)
    assert length[1] > 1.2 * length[2]
    np.testing.assert_allclose(body.centroid[2], SIZE[2] / 2, atol=1e-3)
    level = np.concatenate([body.axes[1:], -body.axes[1:]])
    for height in (0.001, 0.099):
        at = np.append(body.centre[:2], height)
        assert body.holds(at + 0.99 * level).all()
        assert not body.holds(at + 1.01 * level).any()
    np.testing.assert_allclose(np.abs(columns.axis(0, columns.rows(point)[0], 0) @ body.axes[1]), length[1], rtol=1e-6)


def test_a_column_becomes_an_ellipsoid_of_its_volume(ellipsoids):
    point = ellipsoids.of_radii([0.02, 0.02, 0.02])
    columns, upright = ellipsoids.with_other_kind([0, 1], point)
    again, back = columns.with_other_kind([0, 1], upright)
    assert again.is_other_kind.tolist() == [False] * 3
    np.testing.assert_allclose(again.body(0, back).volume, ellipsoids.body(0, point).volume, rtol=0.05)
    np.testing.assert_allclose(columns.odds, -2 * np.log(EllipsoidPrior().odds_for_columns))


def test_a_ball_over_the_wall_ends_there(coarse):
    """The centre of the ball is on the wall: half the volume, and its centroid 3/8 of the radius inside."""
    balls = Ellipsoids.create(coarse.mesh, EllipsoidPrior(modes=1), [[0.05, 0.0, 0.05]], [1])
    body = balls.body(0, balls.of_radii([0.03]))
    np.testing.assert_allclose(body.volume, 2 * np.pi / 3 * 0.03**3, rtol=0.02)
    np.testing.assert_allclose(body.centroid, [0.05 - 3 / 8 * 0.03, 0, 0.05], atol=5e-4)


@pytest.mark.slow
def test_a_ball_is_distinguished_from_a_ghost(coarse, fine, monkeypatch):
    """One mesh fewer than by default, and coarser ones. test_fitted_ellipsoids.py tests a resistive ball with the
    default meshes."""
    monkeypatch.setattr(search, "_MAX_REFINEMENTS", 2)
    monkeypatch.setattr(search, "_RELATIVE_EDGE_LENGTHS_BY_REFINEMENT", ((0.7,), (0.5,)))
    ratio = 4.0
    cut_along, held, rest = fine
    change = np.asarray(cut_along.voltages(BATH * np.where(held, ratio, 1.0))) - rest
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
    mesh, values = found.finer.model.mesh, np.asarray(found.finer.conductivity)
    assert mesh.num_cells == len(values) > coarse.mesh.num_cells
    sharper = np.log(values / BATH / (1 + found.drift))
    np.testing.assert_allclose(np.asarray(measures(mesh)) @ sharper, sign * body.contrast * body.volume, rtol=0.05)
    blurred = [
        np.asarray(measures(on))[np.abs(one / body.contrast * sign - 0.5) < 0.45].sum()
        for on, one in ((mesh, sharper), (coarse.mesh, image))
    ]
    assert blurred[0] < 0.7 * blurred[1]
    assert len(found.doubtful) == 1


def test_displayed_values_on_the_surface_are_half_of_the_contrast(coarse):
    """Cells that are half covered have half the contrast, whatever it is: an isosurface there is the body's surface."""
    balls = Ellipsoids.create(coarse.mesh, EllipsoidPrior(), [BALL], [1])
    coefficients = balls.of_radii([RADIUS])
    _, share, _ = balls.coverage(0, balls.rows(coefficients)[0])
    contrast, shown = balls.body(0, coefficients).contrast, balls.display_image(coefficients)
    np.testing.assert_allclose(shown.sum(), share.sum() * contrast)
    assert shown.max() <= contrast * (1 + 1e-9)
    drifted = balls.display_image(coefficients + np.eye(len(coefficients))[0])
    np.testing.assert_allclose(drifted - shown, EllipsoidPrior().drift)


def test_a_fit_begins_with_the_fields_at_which_another_has_ended(coarse, monkeypatch):
    solved = []
    monkeypatch.setattr(problem, "solved_fields", lambda *given: solved.append(given) or solved_fields(*given))
    given = shape_problem(coarse)
    bodies = Ellipsoids.create(coarse.mesh, EllipsoidPrior(modes=1), [[0.0, 0.0, 0.05]], [1])
    fitted = given.fit(bodies, bodies.of_radii([0.02]), 2)
    number = len(solved)
    again = given.fit(fitted.bodies, fitted.coefficients, 1)
    assert len(solved) == number
    assert again.cost == fitted.cost
    given.fit(fitted.bodies, fitted.coefficients + 0.01, 1)
    assert len(solved) == number + 1


def test_balls_keep_their_volume_on_any_mesh(coarse):
    balls = Ellipsoids.create(coarse.mesh, EllipsoidPrior(modes=1), [[0.0, 0.0, 0.05]], [1])
    for radius in (0.012, 0.02, 0.03):
        np.testing.assert_allclose(balls.body(0, balls.of_radii([radius])).volume, 4 / 3 * np.pi * radius**3, rtol=0.02)


def test_an_unsuitable_smooth_field_is_refused(coarse):
    rest = coarse.voltages(BATH)

    def found(smooth: Any):
        reconstruct_shapes(coarse, rest, BATH, start=[], noise=1e-3, smooth=smooth)

    few = np.arange(len(rest)) < 40
    settings: Any = {"hyperparameter": 5.0, "noise": 1e-3}
    masked = reconstruct(coarse, rest, BATH, prior=Gaussian(0.025), mask=few, **settings)
    with pytest.raises(ValueError, match=r"smooth is an image of \d+ independent channels"):
        found(masked)
    with pytest.raises(ValueError, match="by a smooth prior, with no bounds"):
        found(reconstruct(coarse, rest, BATH, prior=TotalVariation(), **settings))
    with pytest.raises(ValueError, match="smooth"):
        found(0.3)


def test_a_prior_of_a_sheet_is_refused(coarse):
    with pytest.raises(ValueError, match="such as EllipsoidPrior"):
        reconstruct_shapes(coarse, coarse.voltages(BATH), BATH, start=[], prior=StarPrior())


@pytest.mark.parametrize("factor", [0.1, 12.0])
def test_on_a_finer_mesh_a_ball_changes_voltages_as_on_one_cut_along_it(coarse, fine, factor):
    """Its effect is the difference from the voltages of the background, which are those of the given mesh."""
    cut_along, held, rest = fine
    inside = np.asarray(measures(cut_along.mesh))[held].sum()
    there = np.asarray(cut_along.voltages(BATH * np.where(held, factor, 1.0)))
    wanted = (there - rest) * (4 / 3 * np.pi * RADIUS**3 / inside)
    prior = EllipsoidPrior(modes=1, contrast=abs(np.log(factor)))
    balls = Ellipsoids.create(coarse.mesh, prior, [BALL], [1 if factor > 1 else -1])
    fit = ShapeFit(balls, balls.of_radii([RADIUS]), 0.0, ROWS)
    there = refine_at_surfaces(shape_problem(coarse), fit, (0.5,))
    assert coarse.mesh.num_points < there.problem.model.mesh.num_points < 3 * coarse.mesh.num_points
    change = there.change(coarse.protocol, there.bodies.image(fit.coefficients).image, 0.0)
    assert np.linalg.norm(change - wanted) < 0.08 * np.linalg.norm(wanted)
    np.testing.assert_allclose(there.problem.linearise(np.zeros(1), there.bodies.subset([]))[0], 0, atol=1e-6)


def test_plates_and_discs_stay_where_they_are_on_a_finer_mesh():
    mesh = box(*SIZE, num_points=600)
    electrodes = CombinedElectrodes(plates(mesh, ["left"], 0.01), discs(), plates(mesh, ["right"], 0.02))
    given = ForwardModel(mesh, electrodes, opposite(18, current=1e-3))
    problem = shape_problem(given)
    balls = Ellipsoids.create(mesh, EllipsoidPrior(), [[0.0, -0.06, 0.05]], [1])  # outside of the wall
    there = refine_at_surfaces(problem, ShapeFit(balls, balls.of_radii([0.02]), 0.0, ROWS), (0.3,))
    model = there.problem.model
    assert model.mesh.num_points > 2 * mesh.num_points
    area, given_area = (np.asarray(one.electrodes.contact(one.mesh).load).sum(axis=0) for one in (model, given))
    np.testing.assert_allclose(area, given_area, rtol=0.01)


def test_conductivity_of_partly_covered_cells(ellipsoids):
    share = np.array([0.0, 0.5, 1.0])
    conductive, resistive = (
        np.exp(ellipsoids.mixed_log_conductivity(share, np.log(ratio))[0]) for ratio in (4.0, 0.25)
    )
    np.testing.assert_allclose(conductive, [1, 1 / (0.5 + 0.5 / 4), 4], rtol=1e-12)
    np.testing.assert_allclose(resistive, [1, (0.5 + 0.5 * 0.5) ** 2, 0.25], rtol=1e-12)


def test_refined_cells_know_their_parent_cells(coarse, monkeypatch):
    """Of the mesh before all refinements."""
    monkeypatch.setattr(finer_mesh, "_MAX_NODE_RATIO", 10.0)
    balls = Ellipsoids.create(coarse.mesh, EllipsoidPrior(), [BALL], [1])
    there = refine_at_surfaces(shape_problem(coarse), ShapeFit(balls, balls.of_radii([RADIUS]), 0.0, ROWS), (0.6, 0.3))
    volume = np.asarray(measures(there.problem.model.mesh))
    np.testing.assert_allclose(np.bincount(there.cell, volume), np.asarray(measures(coarse.mesh)), rtol=1e-9)


@pytest.mark.slow
def test_edges_are_refined_while_the_mesh_grows_little():
    coarse = model(400)
    balls = Ellipsoids.create(coarse.mesh, EllipsoidPrior(), [BALL], [1])
    fit, problem = ShapeFit(balls, balls.of_radii([RADIUS]), 0.0, ROWS), shape_problem(coarse)
    few, many = (refine_at_surfaces(problem, fit, (edge,)).problem.model.mesh.num_points for edge in (1.0, 0.3))
    assert few < 1.5 * coarse.mesh.num_points < many
    assert refine_at_surfaces(problem, fit, (1.0, 0.3)).problem.model.mesh.num_points == few
    assert refine_at_surfaces(problem, fit, (0.3, 0.2)).problem.model.mesh.num_points == many


def test_bodies_have_moved_if_their_surfaces_have(ellipsoids):
    before = ellipsoids.of_radii([0.02, 0.02, 0.02])
    for coefficient in (1, 4, 6):  # position, radius and one stretch of the first body
        little, far = before.copy(), before.copy()
        little[coefficient] += 0.02
        far[coefficient] += 2.0
        assert not ellipsoids.left_refined_cells(before, ellipsoids, little)
        assert ellipsoids.left_refined_cells(before, ellipsoids, far)
    stronger = before.copy()
    stronger[5] += 2.0
    assert not ellipsoids.left_refined_cells(before, ellipsoids, stronger)
    assert ellipsoids.left_refined_cells(before, ellipsoids.subset([0, 1]), before[:-10])
    columns, upright = ellipsoids.with_other_kind([0], before)
    assert ellipsoids.left_refined_cells(before, columns, upright)
    upright, risen = upright.copy(), upright.copy()
    risen[3] += 2.0  # parameters that a column does not use
    assert not columns.left_refined_cells(upright, columns, risen)


def test_only_starts_required_by_the_data_are_used(coarse, fine):
    cut_along, held, rest = fine
    change = np.asarray(cut_along.voltages(BATH * np.where(held, 4.0, 1.0))) - rest
    frame, noise = np.asarray(coarse.voltages(BATH)) + change, np.full(len(change), 0.03 * np.sqrt(np.mean(change**2)))
    small, data = independent_data(coarse, frame, np.ones(len(change), bool), noise, at_once=True)  # pyright: ignore
    setting = search._FitSetting(ShapeProblem(small, data, np.full(coarse.mesh.num_cells, BATH)), None)
    balls = Ellipsoids.create(coarse.mesh, EllipsoidPrior(modes=1), [BALL + 0.008, [-0.03, 0.04, 0.03]], [1, -1])
    _, fit, chosen = search._add_bodies(setting, balls, balls.of_radii([0.025, 0.02]))
    assert chosen == [0]
    assert len(fit.bodies.sign) == 1


def test_number_and_kinds_are_determined_on_a_refined_mesh(coarse, fine, monkeypatch):
    meshes = []

    def improve(problem, result, least_rise):
        meshes.append(problem.model.mesh.num_points)
        return result

    monkeypatch.setattr(search, "improve_fit", improve)
    monkeypatch.setattr(search, "_MAX_REFINEMENTS", 1)
    cut_along, held, rest = fine
    change = np.asarray(cut_along.voltages(BATH * np.where(held, 4.0, 1.0))) - rest
    frame = np.asarray(coarse.voltages(BATH)) + change
    prior, noise = EllipsoidPrior(modes=1, kinds="ellipsoids"), 0.03 * np.sqrt(np.mean(change**2))
    reconstruct_shapes(coarse, frame, BATH, start=[(1, BALL, RADIUS)], noise=noise, prior=prior)  # pyright: ignore
    (num_points,) = meshes
    assert num_points > coarse.mesh.num_points
