"""Place, contrast, area and strength of bodies with their intervals, in tanks that differ from their description."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import numpy as np
import pytest

from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, image_difference, ring
from jeit.cli.console import format_with_interval
from jeit.data import Measurement
from jeit.electrodes.face_patches import body_mesh
from jeit.image import Inclusion
from jeit.inverse.channels import Data
from jeit.inverse.nonlinear.problem import independent_data
from jeit.inverse.placement import ModelError
from jeit.inverse.shapes import Accuracy, StarPrior, alternatives, reconstruct_shapes
from jeit.inverse.shapes.bodies import Bodies
from jeit.inverse.shapes.problem import MovedElectrodes, ShapeProblem, SmoothField
from jeit.inverse.shapes.quantities import _FixedContrastFit, _summary, centroid_radius
from jeit.inverse.shapes.search import _FitSetting
from jeit.mesh import centroids, measures

RADIUS, SIGMA = 0.1, 0.02
DISK, PROTOCOL = Disk(RADIUS), adjacent(16, current=1e-3)
DESCRIBED = BoundaryElectrodes(ring(RADIUS, 16), 0.02, 0.005)


def imaged(change, radius, seed=0, degrees=1.5):
    """The image of a round body in a tank whose electrodes are off by `degrees` and whose contact impedances differ by
    a factor of two."""
    rng = np.random.default_rng(seed)
    place = np.asarray(DESCRIBED.position)
    angle = np.arctan2(place[:, 1], place[:, 0]) + np.deg2rad(degrees) * rng.normal(size=16)
    place = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    electrodes = BoundaryElectrodes(place, 0.02, 0.005 * np.exp(0.7 * rng.normal(size=16)))
    model = ForwardModel(body_mesh(DISK, electrodes, 5000), electrodes, PROTOCOL)
    middle = np.asarray(centroids(model.mesh))
    inside = np.linalg.norm(middle - [0.02, 0.035], axis=1) < radius
    frames = []
    for conductivity in (np.full(len(middle), SIGMA), SIGMA * np.where(inside, 1 + change, 1.0)):
        voltages = np.asarray(model.voltages(conductivity))
        voltages = voltages * (1 + 0.003 * rng.normal(size=len(voltages)))
        mask = np.ones(voltages.shape, bool)
        frames.append(Measurement(voltages, mask, PROTOCOL, electrodes=DESCRIBED, domain=DISK))
    return image_difference(frames[1], frames[0])


def test_quantities_of_a_fitted_body_and_wider_intervals_by_model_errors(monkeypatch):
    """The median is the truth, and model errors widen the intervals. The data are free of noise.

    The data are of the same mesh, so that the error of the mesh is set to zero.
    """
    monkeypatch.setitem(alternatives._MESH_LOG_CONTRAST_DEVIATION, 2, 1e-9)
    model = ForwardModel(DISK.mesh(num_points=500), DESCRIBED, PROTOCOL)
    middle, radius = np.asarray(centroids(model.mesh)), 0.025
    inside = np.linalg.norm(middle - [0.02, 0.035], axis=1) < radius
    voltages = np.asarray(model.voltages(SIGMA * np.where(inside, 3.0, 1.0)))
    noise = 0.003 * np.abs(voltages)
    widths, radii = [], []
    for error in (None, ModelError(np.diag(np.repeat([1e-3, 0.3], 16)))):
        found = reconstruct_shapes(
            model, voltages, SIGMA, start=[(1, (0.02, 0.03), 0.02)], noise=noise, prior=StarPrior(modes=1),
            accuracy=Accuracy(noise, error),
        )  # fmt: skip
        (one,) = found.bodies
        area = float(np.asarray(measures(model.mesh))[inside].sum())
        assert one.quantities.strength == pytest.approx(area / 2, rel=0.05)
        assert one.quantities.change == pytest.approx(2.0, rel=0.25)
        assert one.area == pytest.approx(one.quantities.measure, rel=1e-6)
        assert one.contrast == pytest.approx(np.log1p(one.quantities.change))
        low, high = one.quantities.change_interval
        widths.append(high - low)
        radii.append(one.quantities.centroid_radius)
    assert widths[1] > 1.2 * widths[0]
    assert radii[1] > 1.2 * radii[0] > 0


def test_errors_that_nothing_explains_widen_intervals():
    """Of data with ten times the noise that is stated, intervals are as wide as where the true noise is stated."""
    model = ForwardModel(DISK.mesh(num_points=500), DESCRIBED, PROTOCOL)
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.02, 0.035], axis=1) < 0.025
    voltages = np.asarray(model.voltages(SIGMA * np.where(inside, 3.0, 1.0)))
    noise = 0.02 * np.abs(voltages)
    voltages = voltages + noise * np.random.default_rng(0).normal(size=len(voltages))
    widths = []
    for stated in (noise, 0.1 * noise):
        found = reconstruct_shapes(
            model, voltages, SIGMA, start=[(1, (0.02, 0.03), 0.02)], noise=noise, prior=StarPrior(modes=1),
            accuracy=Accuracy(stated),
        )  # fmt: skip
        low, high = found.bodies[0].quantities.strength_interval
        widths.append(high - low)
    assert widths[1] == pytest.approx(widths[0], rel=0.2)


def test_a_body_fitted_with_the_other_sign_has_quantities():
    """Of a resistive disc for which a conductive body is fitted, whose contrast is then negative."""
    model = ForwardModel(DISK.mesh(num_points=300), DESCRIBED, PROTOCOL)
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.02, 0.035], axis=1) < 0.025
    voltages = np.asarray(model.voltages(SIGMA * np.where(inside, 0.6, 1.0)))
    noise = 1e-4 * np.abs(voltages)
    options = {"noise": noise, "prior": StarPrior(modes=1), "accuracy": Accuracy(noise, None)}
    bodies = reconstruct_shapes(model, voltages, SIGMA, start=[(1, (0.02, 0.03), 0.02)], **options).bodies
    found = [(one.quantities.change, one.quantities.measure, one.quantities.strength) for one in bodies]
    assert len(found) > 0
    assert np.isfinite(found).all()


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_radius_of_a_place_holds_68_percent_of_a_posterior(dimension):
    """Of centroids that depend linearly on the coefficients of the second of two bodies, against samples; with an error
    of 10 % of the distance from the middle of the mesh, and about another centre."""
    random = np.random.default_rng(dimension)
    size, number = 5, 11
    factor, slope = random.normal(size=(number, number)), 1e-3 * random.normal(size=(dimension, size))
    middle, centroid, shown = 0.3, 0.3 + 0.02 * np.arange(1, dimension + 1), np.full(dimension, 2e-3)

    def body(k, coefficients):
        assert k == 1
        return SimpleNamespace(centroid=centroid + slope @ coefficients[1 + size :])

    covariance = factor @ factor.T
    problem = SimpleNamespace(
        model=SimpleNamespace(mesh=SimpleNamespace(points=middle + np.array([[-1.0] * dimension, [1.0] * dimension]))),
        covariance=lambda fit: covariance,
    )
    bodies: Any = SimpleNamespace(body=body, prior=SimpleNamespace(size=size), span=2.0)
    bodies.centroid_slope = partial(Bodies.centroid_slope, bodies)
    fit = SimpleNamespace(bodies=bodies, coefficients=np.zeros(number))
    samples = random.normal(size=(100_000, number)) @ factor.T
    offsets = samples[:, 1 + size :] @ slope.T + 0.1 * random.normal(size=(100_000, 1)) * (centroid - middle)
    accuracy = Accuracy(np.ones(1), None, size=0.1, strength=0.0)  # pyright: ignore
    radius = centroid_radius(problem, fit, 1, centroid, accuracy)  # pyright: ignore
    assert np.mean(np.linalg.norm(offsets, axis=1) < radius) == pytest.approx(0.68, abs=0.015)
    displaced = centroid_radius(problem, fit, 1, centroid - shown, accuracy)  # pyright: ignore
    assert displaced == pytest.approx(np.hypot(radius, np.linalg.norm(shown)))
    wider = centroid_radius(problem, fit, 1, centroid, accuracy._replace(strength=0.1))  # pyright: ignore
    assert wider > 1.02 * radius
    slope[:] = 0  # a body that cannot move
    assert centroid_radius(problem, fit, 1, centroid - shown, accuracy._replace(size=0.0)) == pytest.approx(  # pyright: ignore
        np.linalg.norm(shown)
    )


@pytest.mark.slow
def test_errors_of_the_mesh_and_of_the_size_widen_intervals(monkeypatch):
    """By 0.3 of log σ, far more than by the data, by 5 % of each length, and by 10 % of each strength."""
    model = ForwardModel(DISK.mesh(num_points=500), DESCRIBED, PROTOCOL)
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.02, 0.035], axis=1) < 0.025
    voltages = np.asarray(model.voltages(SIGMA * np.where(inside, 3.0, 1.0)))
    noise = 3e-3 * np.abs(voltages)
    options = {"start": [(1, (0.02, 0.03), 0.02)], "noise": noise, "prior": StarPrior(modes=1)}
    found = {}
    for mesh, size, strength in ((1e-9, 1e-9, 0.0), (0.3, 1e-9, 0.0), (1e-9, 0.05, 0.0), (1e-9, 1e-9, 0.1)):
        monkeypatch.setitem(alternatives._MESH_LOG_CONTRAST_DEVIATION, 2, mesh)
        accuracy = Accuracy(noise, None, size, strength)
        (one,) = reconstruct_shapes(model, voltages, SIGMA, accuracy=accuracy, **options).bodies
        low, high = one.quantities.change_interval
        found[mesh, size + strength] = (
            np.log((1 + high) / (1 + low)) / 2,
            np.ptp(np.log(one.quantities.measure_interval)) / 2,
        )
    assert max(found[1e-9, 1e-9]) < 0.05
    assert 0.2 < found[0.3, 1e-9][0] < 0.35
    assert found[1e-9, 0.05][1] == pytest.approx(0.1, rel=0.1)  # of an area, twice that of a length
    assert found[1e-9, 0.05][0] == pytest.approx(found[1e-9, 1e-9][0], rel=1e-6)
    assert found[1e-9, 1e-9 + 0.1][1] == pytest.approx(0.1, rel=0.1)
    # The outline has the median area; if the data do not determine the area of a small body, it is that of the fit.
    for low, times in ((one.area, 2.0), (None, 1.0)):
        known = replace(one.quantities, measure=2 * one.area, measure_interval=(low, 3 * one.area))
        assert one.with_quantities(known).area == pytest.approx(times * one.area)


def test_other_weights_of_the_data_keep_the_smooth_field():
    """The covariance of the smooth field is in volts, and does not depend on the weights of the data."""
    random = np.random.default_rng(0)
    jacobian, weights = random.normal(size=(4, 3)), (np.ones(4), random.uniform(1, 3, 4))
    data = [Data(np.zeros(4), one, np.eye(4), np.eye(4), 0.0) for one in weights]  # pyright: ignore
    alone = ShapeProblem(None, data[0], np.ones(2))  # pyright: ignore
    setting = _FitSetting(alone, SmoothField(jacobian, alone, (), None, np.ones(2)))  # pyright: ignore
    found = setting.weighted(data[1]).problem(0.5).data
    volts = np.asarray(found.covariance) / np.outer(weights[1], weights[1])
    np.testing.assert_allclose(volts, np.diag(1 / weights[1] ** 2) + 0.25 * jacobian @ jacobian.T, rtol=1e-12)


def test_changes_of_electrodes_are_errors_of_the_channels_and_are_estimated():
    """Displacements and contact impedances that change the voltages of an empty sheet, against models of the changed
    electrodes."""
    points = ring(0.1, 8)
    electrodes = BoundaryElectrodes(points, 0.02, 0.01)
    model = ForwardModel(Disk(0.1).mesh(num_points=700), electrodes, adjacent(8, driven_electrodes=True))
    rest = np.asarray(model.voltages(SIGMA))
    independent, data = independent_data(model, rest, np.full(len(rest), True), 1e-4 * np.abs(rest), at_once=True)
    problem = ShapeProblem(independent, data, np.full(model.mesh.num_cells, SIGMA))
    changes = MovedElectrodes.create(problem, 2e-3)
    assert changes is not None
    assert MovedElectrodes.create(problem, 0.0) is None
    assert changes.jacobian.shape == (len(data.weight), 16)
    position, angle = np.array(points), np.arctan2(*points[2][::-1]) + 2e-4
    position[2] = 0.1 * np.cos(angle), 0.1 * np.sin(angle)
    for number, step, share, changed in (
        (2, 0.01, 0.1, eqx.tree_at(lambda one: one.position, electrodes, position)),
        (8 + 5, 0.1, 0.02, electrodes.with_contact_impedance(0.01 * np.exp(0.03 * (np.arange(8) == 5)))),
    ):
        moved = np.asarray(model.with_electrodes(changed).voltages(SIGMA))
        # Small parts of a standard deviation: 0.02 mm counter-clockwise, or 3 % of an impedance.
        expected = step * np.asarray(changes.jacobian)[:, number]
        measured = independent_data(model, moved, np.full(len(rest), True), 1e-4 * np.abs(rest), at_once=True)[1]
        difference = np.asarray(data.weight) * (np.asarray(measured.voltages) - np.asarray(data.voltages))
        assert np.linalg.norm(difference - expected) < share * np.linalg.norm(difference)
        fit: Any = SimpleNamespace(rows=(-difference, None))
        estimate = changes.voltages(1.0, fit, model.protocol)
        assert np.linalg.norm(estimate - (moved - rest)) < share * np.linalg.norm(moved - rest)
        tenth: Any = SimpleNamespace(rows=(-0.1 / step * difference, None))  # of a standard deviation
        assert changes.most_likely_level(tenth) > 0
    assert changes.most_likely_level(SimpleNamespace(rows=(np.zeros(len(data.weight)), None))) == 0  # pyright: ignore


def test_errors_are_scaled_to_the_misfit_of_a_fit():
    """A misfit is in standard deviations, and after scaling by it, it is one. Rounding makes no misfit negative."""
    random = np.random.default_rng(1)
    root, residual = random.normal(size=(4, 4)), 3 * random.normal(size=4)
    covariance = np.eye(4) + root @ root.T
    problem = ShapeProblem(None, Data(np.zeros(4), np.ones(4), covariance, np.linalg.inv(covariance), 0.0), np.ones(2))  # pyright: ignore
    fit: Any = SimpleNamespace(rows=(np.append(residual, 9.0), None))  # one pair of bodies follows the channels
    misfit = problem.misfit(fit)
    assert misfit == pytest.approx(np.sqrt(residual @ np.linalg.solve(covariance, residual) / 4))
    scaled = problem.with_scaled_errors(misfit)
    assert scaled.misfit(fit) == pytest.approx(1)
    np.testing.assert_allclose(scaled.data.covariance, misfit**2 * covariance)
    np.testing.assert_allclose(scaled.data.precision @ scaled.data.covariance, np.eye(4), atol=1e-12)
    rounded = replace(problem, data=replace(problem.data, precision=-1e-16 * np.eye(4)))
    assert rounded.misfit(fit) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("change", "radius"), [(0.5, 0.027), (2.0, 0.025), (-0.5, 0.02), (9.0, 0.012)])
def test_quantities_in_a_tank_that_differs_from_its_description(change, radius):
    """Within twice their intervals. Without model errors they were wrong by up to two orders of magnitude."""
    result = imaged(change, radius)
    (one,) = result.inclusions
    distance = np.linalg.norm(np.array(one.centroid) - [0.02, 0.035])
    assert distance < min(0.02 * RADIUS, 2 * one.centroid_radius)
    area = np.pi * radius**2
    for value, interval in (
        (change, one.contrast_interval),
        (area, one.area_interval),
        (area * change / (2 + change), one.strength_interval),
    ):
        low, high = (np.nan if end is None else end for end in interval)
        middle = np.nanmean([low, high])
        reach = np.nanmax([abs(high - low), 0.1 * abs(middle)])
        assert not value < low - reach
        assert not value > high + reach


def held(contrast, negative_log_likelihood, area=1e-3):
    return _FixedContrastFit(float(np.log(contrast)), negative_log_likelihood, float(np.log(area)), 0.05)


def test_summary_of_a_likelihood():
    """A parabola about a contrast of one with deviation 0.1: without the prior, half of its mass lies below."""
    places = np.exp(np.linspace(-0.5, 0.5, 21))
    found = _summary(1, 2, 0.0, [held(one, 0.5 * (np.log(one) / 0.1) ** 2) for one in places])
    assert found.change == pytest.approx(np.expm1(1.0), rel=0.02)
    low, high = found.change_interval
    assert low == pytest.approx(np.expm1(np.exp(-0.1)), rel=0.03)
    assert high == pytest.approx(np.expm1(np.exp(0.1)), rel=0.03)
    assert found.measure == pytest.approx(1e-3, rel=0.01)
    assert found.measure_interval == pytest.approx((0.95e-3, 1.05e-3), rel=0.01)
    assert found.strength == pytest.approx(1e-3 * np.tanh(0.5), rel=0.02)


@pytest.mark.parametrize("sign", [1, -1])
def test_undetermined_ends_of_intervals(sign):
    strong = _summary(sign, 2, 0.0, [held(one, 40 / one if one < 3 else 0.2) for one in (0.5, 1.0, 2.0, 3.0, 4.5)])
    assert strong.change_interval[sign > 0] is None
    assert strong.change_interval[sign < 0] is not None
    assert strong.measure_interval[0] is None
    assert None not in strong.strength_interval
    weak = _summary(sign, 2, 0.0, [held(one, 40 * one**2) for one in (0.03, 0.05, 0.1, 0.3, 0.5)])
    assert weak.change_interval[sign < 0] is None
    assert weak.measure_interval[1] is None


def test_intervals_as_text():
    def written(value):
        return f"{value:g}"

    assert format_with_interval(2.0, (1.0, 3.0), written) == "2\n1 to 3"
    assert format_with_interval(2.0, (1.0, None), written) == "at least 1"
    assert format_with_interval(2.0, (None, 3.0), written) == "at most 3"
    assert format_with_interval(2.0, (None, None), written) == "not determined"
    assert format_with_interval(2.0, None, written) == "2"
    assert Inclusion(1, (0.0, 0.0), 1.0, 1.0).contrast_interval is None
