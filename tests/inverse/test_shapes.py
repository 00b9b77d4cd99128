"""Bodies as star shapes: derivatives, geometry, and estimates in tanks solved on another mesh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse.shapes import Star, StarPrior, reconstruct_shapes
from jeit.inverse.shapes.number_and_kinds import remove_unsupported
from jeit.inverse.shapes.problem import ShapeFit
from jeit.inverse.shapes.star import Stars
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent

RADIUS, BATH = 0.1, 0.02
ELECTRODES = BoundaryElectrodes(ring(RADIUS, 16), 0.015, 0.01)
SQUARE, DISK = np.array([0.04, 0.02]), np.array([-0.035, -0.03])
STARTS = [(1, (0.03, 0.03), 0.02), (-1, (-0.03, -0.02), 0.02), (1, (0.02, -0.06), 0.015), (-1, (-0.05, 0.05), 0.02)]


@pytest.fixture(scope="module")
def model():
    return ForwardModel(Disk(RADIUS).mesh(num_points=2000), ELECTRODES, adjacent(16, current=1e-3))


@pytest.fixture(scope="module")
def fine():
    return ForwardModel(Disk(RADIUS).mesh(num_points=6000), ELECTRODES, adjacent(16, current=1e-3))


@pytest.fixture(scope="module")
def frame(fine):
    """A square of metal and a disk of plastic in a bath of 5 % higher conductivity, on a fine mesh, with 0.1 %
    noise."""
    place = np.asarray(centroids(fine.mesh))
    square = np.abs(place - SQUARE).max(axis=1) < 0.018
    disk = np.linalg.norm(place - DISK, axis=1) < 0.025
    clean = np.asarray(fine.voltages(1.05 * BATH * np.where(square, 100.0, np.where(disk, 0.01, 1.0))))
    return clean * (1 + 1e-3 * np.random.default_rng(0).normal(size=clean.shape))


@pytest.fixture(scope="module")
def found(model, frame):
    return reconstruct_shapes(model, frame, BATH, start=STARTS, noise=0.03 * np.abs(frame))


def test_derivatives_equal_finite_differences(model):
    stars = Stars.create(model.mesh, StarPrior(), [[0.01, 0.02], [-0.01, 0.0], [0.01, -0.02]], [1, -1, 1])
    rng = np.random.default_rng(0)
    point = stars.of_radii([0.03, 0.02, 0.03]) + 0.2 * rng.normal(size=1 + 3 * stars.prior.size)
    stars, point = stars.with_other_kind([2], point)
    along = rng.normal(size=point.shape)
    here, step = stars.image(point), 1e-6
    ahead, behind = stars.image(point + step * along), stars.image(point - step * along)
    assert here.overlap.shape == (3,)
    assert here.overlap.min() > 1e-3
    change = np.zeros(model.mesh.num_cells)
    for (cells, slope), part in zip(here.slopes, np.split(along, [1, 11, 21]), strict=True):
        change[cells] += slope @ part
    np.testing.assert_allclose(change, (ahead.image - behind.image) / (2 * step), rtol=1e-6, atol=1e-6)
    difference = (ahead.overlap - behind.overlap) / (2 * step)
    np.testing.assert_allclose(here.overlap_slope @ along, difference, rtol=1e-6)


def test_area_centroid_and_interior_of_a_star(model):
    stars = Stars.create(model.mesh, StarPrior(), [[0.03, 0.01]], [-1])
    round_one = stars.body(0, stars.of_radii([0.02]))
    assert round_one.sign == -1
    np.testing.assert_allclose(round_one.area, np.pi * 0.02**2, rtol=1e-3)
    np.testing.assert_allclose(round_one.centroid, [0.03, 0.01], atol=1e-6)
    rough = stars.body(0, stars.of_radii([0.02]) + np.random.default_rng(1).normal(size=1 + stars.prior.size))
    axis = np.linspace(-0.15, 0.15, 601)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    inside = rough.holds(grid)
    np.testing.assert_allclose(inside.sum() * (axis[1] - axis[0]) ** 2, rough.area, rtol=0.02)
    np.testing.assert_allclose(grid[inside].mean(axis=0), rough.centroid, atol=5e-4)


@pytest.mark.parametrize("reach", [0.085, 0.105])
def test_a_star_ends_where_the_body_does(model, reach):
    """A disk across the edge of the tank with its centre inside or outside: the area of the lens of two circles."""
    stars = Stars.create(model.mesh, StarPrior(), [[reach, 0.0]], [1])
    star, radius = stars.body(0, stars.of_radii([0.03])), 0.03
    assert np.linalg.norm(star.outline, axis=1).max() < 1.001 * RADIUS
    angle = [
        np.arccos((reach**2 + one**2 - other**2) / (2 * reach * one))
        for one, other in ((radius, RADIUS), (RADIUS, radius))
    ]
    lens = sum(one**2 * (a - np.sin(2 * a) / 2) for one, a in zip((radius, RADIUS), angle, strict=True))
    np.testing.assert_allclose(star.area, lens, rtol=0.02)
    assert star.holds(star.centroid)
    assert not star.holds(np.array([1.01 * RADIUS, 0.0]))


def test_bodies_are_detected_and_ghosts_rejected(found):
    assert [one.sign for one in sorted(found.bodies, key=lambda one: one.sign)] == [-1, 1]
    plastic, metal = sorted(found.bodies, key=lambda one: one.sign)
    assert np.linalg.norm(metal.centroid - SQUARE) < 0.02 * RADIUS
    assert np.linalg.norm(plastic.centroid - DISK) < 0.02 * RADIUS
    np.testing.assert_allclose(metal.area, 0.036**2, rtol=0.05)
    np.testing.assert_allclose(plastic.area, np.pi * 0.025**2, rtol=0.1)
    assert len(found.doubtful) == 2
    assert max(one.rise for one in found.doubtful) < 2 < 100 < min(one.rise for one in found.bodies)
    np.testing.assert_allclose(found.drift, 0.05, atol=0.01)
    assert float(found.misfit) < 1


class Named:
    """Bodies of a sheet that have only a name."""

    dimension = 2

    def __init__(self, names):
        self.names = self.sign = names

    def without(self, k, coefficients):
        return Named(self.names[:k] + self.names[k + 1 :]), coefficients

    def body(self, k, coefficients, rise):
        return self.names[k], rise


class Listed:
    """A problem whose cost is listed for every set of bodies, and whose log evidence falls by `weight` with each."""

    def __init__(self, costs, weight):
        self.costs, self.weight = costs, weight

    def fit(self, bodies, coefficients, *steps):
        return ShapeFit(bodies, coefficients, self.costs[bodies.names], ())

    def negative_log_evidence(self, fit):
        return fit.cost + self.weight * len(fit.bodies.names)


@pytest.mark.parametrize(
    ("least_rise", "weight", "left", "ghosts"),
    [
        (1.2, 0.0, "ab", [("c", 1.1)]),
        (1.4, 0.0, "a", [("c", 1.1), ("b", 1.25)]),
        (1.0, 1.9, "abc", []),  # 4 more in the cost, of which 1.9 are lost with the parameters: more than 2 are left
        (1.0, 2.1, "ab", [("c", 1.1)]),
    ],
)
def test_ghosts_are_removed_weakest_first(least_rise, weight, left, ghosts):
    """By the factor by which the cost rises without a body, and by the evidence for the body."""
    costs = {"abc": 40.0, "ab": 44.0, "ac": 60.0, "bc": 900.0, "a": 55.0, "b": 950.0, "": 2000.0}
    problem = Listed(costs, weight)
    result = remove_unsupported(problem, problem.fit(Named("abc"), np.zeros(3)), (), least_rise)
    assert result.fit.bodies.names == left
    assert [name for name, _ in result.doubtful] == [name for name, _ in ghosts]
    np.testing.assert_allclose([rise for _, rise in result.doubtful], [rise for _, rise in ghosts])
    # Body a is beyond doubt, so it is left out only once.
    rises = {"abc": [900 / 40, 60 / 40, 44 / 40], "ab": [900 / 44, 55 / 44], "a": [900 / 55]}
    np.testing.assert_allclose(result.objective_ratios, rises[left])


@pytest.mark.slow
def test_merged_neighbours_are_separated(model, fine):
    """Two disks of plastic, from one start between them."""
    places = np.array([[0.03, 0.03], [0.03, -0.02]])
    result = reconstruct_shapes(model, _solved(fine, places, 0.02, 1e-2), BATH, start=[(-1, (0.03, 0.0), 0.03)])
    assert [one.sign for one in result.bodies] == [-1, -1]
    found = sorted((one.centroid for one in result.bodies), key=lambda place: -place[1])
    np.testing.assert_allclose(found, places, atol=0.02 * RADIUS)


@pytest.mark.parametrize("factor", [0.6, pytest.param(1.5, marks=pytest.mark.slow), 100.0])
def test_weak_bodies_are_distinguished_from_small_strong_ones(model, fine, factor):
    sign = 1 if factor > 1 else -1
    voltages = _solved(fine, [[0.03, 0.03]], 0.03, factor)
    noise = 0.01 * jnp.abs(voltages)
    (body,) = reconstruct_shapes(model, voltages, BATH, start=[(sign, (0.03, 0.02), 0.02)], noise=noise).bodies
    assert body.weak == (factor < 10)
    np.testing.assert_allclose(body.area, np.pi * 0.03**2, rtol=0.25)
    if body.weak:
        np.testing.assert_allclose(body.contrast, abs(np.log(factor)), rtol=0.3)


def _solved(fine, places, radius, factor):
    """Voltages of disks on a fine mesh."""
    distance = np.linalg.norm(np.asarray(centroids(fine.mesh))[:, None] - np.asarray(places), axis=2).min(axis=1)
    return fine.voltages(jnp.asarray(BATH * np.where(distance < radius, factor, 1.0)))


def test_conductivity_is_that_of_the_stars(found, model):
    relative = np.asarray(found.conductivity) / BATH
    metal = next(one for one in found.bodies if one.sign > 0)
    inside = metal.holds(np.asarray(centroids(model.mesh)))
    assert np.median(relative[inside]) > 10
    np.testing.assert_allclose(np.median(relative[~inside]), 1 + found.drift, rtol=1e-6)
    np.testing.assert_allclose(model.voltages(found.conductivity), found.voltages, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("apart", "ghosts"), [(1e3, 2), (1e-6, 0)])
def test_overlapping_bodies_do_not_cancel(model, frame, apart, ghosts):
    """Two of opposite sign at a place without a body: as separate ghosts they are rejected, otherwise they would pass
    for bodies."""
    pair = [(1, (0, 0.05), 0.04), (-1, (0, 0.05), 0.04)]
    result = reconstruct_shapes(
        model, frame, BATH, start=[*STARTS[:2], *pair], noise=0.03 * np.abs(frame), prior=StarPrior(apart=apart)
    )
    assert (len(result.bodies), len(result.doubtful)) == (4 - ghosts, ghosts)
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-RADIUS, RADIUS, 200)]), axis=-1)
    covered = np.sum([one.holds(grid) for one in result.bodies], axis=0)
    assert ((covered > 1).mean() < 1e-3) == (ghosts == 2)


def test_without_starts_only_the_drift_is_estimated(model):
    result = reconstruct_shapes(model, model.voltages(1.1 * BATH), BATH, start=[])
    assert result.bodies == result.doubtful == ()
    np.testing.assert_allclose(result.drift, 0.1, atol=1e-3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"start": [(2, (0, 0), 0.01)]}, r"signs are \+1 or -1"),
        ({"start": [(1, (0, 0), -0.01)]}, "radii positive"),
        ({"start": [(1, (np.nan, 0), 0.01)]}, "centres finite"),
        ({"start": [(1, 0.01)]}, "start: give"),
        ({"start": 3}, "start: give"),
        ({"prior": "smooth"}, "such as StarPrior"),
        ({"least_rise": 0.5}, "least_rise"),
        ({"noise": -1.0}, "noise"),
        ({"background": -1.0}, "positive"),
    ],
)
def test_invalid_arguments_are_refused(model, frame, given, message):
    arguments = {"background": BATH, "start": STARTS, **given}
    with pytest.raises(ValueError, match=message):
        reconstruct_shapes(model, frame, arguments.pop("background"), **arguments)


@pytest.mark.parametrize("wrong", [{"modes": 0}, {"modes": 2.5}, {"roughness": -1}, {"contrast": "strong"}])
def test_invalid_priors_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        StarPrior(**wrong)


def test_traced_data_are_refused(model, frame):
    with pytest.raises(ValueError, match="reconstruct_shapes"):
        jax.grad(lambda v: reconstruct_shapes(model, v, BATH, start=STARTS).misfit)(jnp.asarray(frame))


def test_stars_contain_plain_values():
    star = Star(1, np.zeros(2), np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]]), 3.5, False, 2.0)
    np.testing.assert_allclose(star.area, 2.0)
    assert star.holds(np.array([[0.0, 0.0], [0.9, 0.0], [2.0, 0.0]])).tolist() == [True, True, False]
