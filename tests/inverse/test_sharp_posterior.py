"""Uncertainty of total-variation images: against the inverse of a dense matrix, samples and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, FacePatches
from jeit.forward import ForwardModel
from jeit.inverse import Parametrisation, TotalVariation, posterior, reconstruct
from jeit.inverse.nonlinear import Background, GaussNewton, LevenbergMarquardt
from jeit.layout import ring
from jeit.mesh import Disk, box, centroids, gradients, measures
from jeit.protocol import adjacent
from jeit_solvers.engines import on_host


def sheet():
    electrodes = BoundaryElectrodes(ring(0.1, 8), 0.012, 1e-3)
    return ForwardModel(Disk(0.1).mesh(num_points=80), electrodes, adjacent(8))


def solid():
    sides = (1, 0), (0, 1), (-1, 0), (0, -1)
    plates = FacePatches(np.array([(0.1 * x, 0.1 * y, z) for z in (0.06, 0.14) for x, y in sides]), 0.06, 0.06, 1e-2)
    return ForwardModel(box(0.2, 0.2, 0.2, num_points=120), plates, adjacent(8))


@pytest.fixture(scope="module", params=[sheet, solid], ids=["sheet", "solid"])
def model(request):
    return request.param()


@pytest.fixture(scope="module")
def image(model):
    """An image by total variation."""
    return sharp(model)


def inside(model):
    """A ball, or a disk."""
    centre = np.asarray(centroids(model.mesh))
    return np.linalg.norm(centre - np.array([0.04, 0.02, 0.1])[: centre.shape[1]], axis=1) < 0.05


def sharp(model, smoothing=0.01, hyperparameter=300.0, parametrisation=None):
    voltages = model.voltages(np.where(inside(model), 0.5, 1.0))
    prior, noise = TotalVariation(smoothing), 3e-3 * np.abs(voltages)
    options = {"prior": prior, "hyperparameter": hyperparameter, "noise": noise, "parametrisation": parametrisation}
    return reconstruct(model, voltages, 1.0, solver=GaussNewton(max_steps=6), **options)


def precision(inversion, coefficients):
    """Q (n, n) of the prior and S (m, n), dense, by definition: the weights of jumps or slopes at the solution."""
    penalty, mesh, count = inversion.penalty, inversion.model.mesh, inversion.basis.num_coefficients
    image = np.asarray(penalty.reference + coefficients[:count])
    if mesh.dimension == 2:
        every, level, shapes = np.arange(len(penalty.pairs)), penalty.level, np.eye(count)
        across = np.zeros((len(every), 1, count))
        across[every, 0, penalty.pairs[:, 0]], across[every, 0, penalty.pairs[:, 1]] = 1, -1
        least = float(penalty.smoothing)
    else:
        every, level, shapes = np.arange(mesh.num_cells), penalty.pull, np.zeros((mesh.num_cells, count))
        across = np.zeros((len(every), 3, count))
        for corner, slope in zip(np.asarray(mesh.cells).T, np.swapaxes(gradients(mesh), 0, 1), strict=True):
            across[every, :, corner] = slope
            shapes[every, corner] = 1 / 4
        least = np.asarray(penalty.steepness)
    height = np.sqrt(((across @ image) ** 2).sum(axis=1) + least**2)
    form = np.einsum("fdi,f,fdj->ij", across, np.asarray(penalty.weight) / height, across, optimize=True)
    whole = np.eye(inversion.num_coefficients)
    whole[:count, :count] = form + np.diag(level)
    return whole, np.concatenate([shapes, np.zeros((len(shapes), len(whole) - count))], axis=1)


def covariance(found):
    """Σ (n, n) by inverting the whole matrix, and S (m, n), with a background if it was estimated."""
    inversion, ended = found.inversion, found.coefficients
    prior, shapes = precision(inversion, ended)
    jacobian = np.asarray(inversion.linearise(ended)[1])
    if inversion.unknowns:
        shapes[:, -1] = inversion.unknowns[0].deviation[0]
    return np.linalg.inv(prior + jacobian.T @ np.asarray(inversion.data.precision) @ jacobian), shapes


def diagonal(shapes, matrix):
    return np.einsum("mi,ij,mj->m", shapes, matrix, shapes, optimize=True)


def assert_as_inverted(found, mask):
    around, values = posterior(found), np.asarray(found.conductivity)
    inverse, shapes = covariance(found)
    deviation = np.asarray(around.standard_deviation())
    np.testing.assert_allclose(deviation, values * np.sqrt(diagonal(shapes, inverse)), rtol=1e-8)
    area = np.where(mask, np.asarray(measures(found.inversion.model.mesh)), 0)
    row = (area / area.sum() * values) @ shapes
    mean, spread = around.region(mask)
    assert mean == pytest.approx(area @ values / area.sum(), rel=1e-12)
    assert spread == pytest.approx(np.sqrt(row @ inverse @ row), rel=1e-8)
    return around, inverse


@pytest.mark.parametrize("smoothing", [0.01, 1e-5])
def test_deviations_equal_those_of_the_inverted_matrix(smoothing, model):
    found = sharp(model, smoothing)
    assert np.ptp(np.log(np.asarray(found.conductivity))) > 0.2  # there is an edge
    assert_as_inverted(found, inside(model))


@pytest.mark.slow
def test_deviations_with_an_estimated_background(model):
    """The background is free both in the image and as an unknown, but the data determine the sum."""
    found = sharp(model, parametrisation=Parametrisation(unknowns=[Background(0.2)]))
    around, inverse = assert_as_inverted(found, inside(model))
    expected = 0.2 * np.sqrt(inverse[-1, -1])
    assert float(around.unknowns()["Background"][0]) == pytest.approx(expected, rel=1e-7)


def test_components_almost_free_in_the_prior_are_determined_by_the_data(model):
    """A constant image is penalised only by the weak attraction to the background."""
    price = 1e6
    found = sharp(model, hyperparameter=price)
    mean, deviation = posterior(found).region(np.ones(model.mesh.num_cells, bool))
    jacobian = np.asarray(found.inversion.linearise(found.coefficients)[1])
    even = jacobian @ np.ones(jacobian.shape[1])
    weight = even @ np.asarray(found.inversion.data.precision) @ even + price * 1e-3  # of log σ, everywhere equal
    assert deviation / mean == pytest.approx(1 / np.sqrt(weight), rel=0.01)
    assert deviation / mean < 0.1 / np.sqrt(price * 1e-3)


def test_data_reduce_every_deviation_and_intervals_contain_the_image(model):
    found = sharp(model, hyperparameter=30.0)
    around = posterior(found)
    free = np.sqrt(np.asarray(around.prior.variance(around.inversion.basis)))
    relative = np.asarray(around.standard_deviation()) / np.asarray(found.conductivity)
    assert (np.isfinite(relative) & (relative > 0) & (relative < 0.5 * free)).all()
    lower, upper = around.credible_interval(0.9)
    assert ((lower < found.conductivity) & (found.conductivity < upper)).all()


def test_scatter_of_samples_equals_the_deviations(model, image):
    found = image
    inverse, shapes = covariance(found)
    drawn = np.log(np.asarray(posterior(found).sample(jax.random.key(0), 1500))) - np.log(found.conductivity)
    assert drawn.shape == (1500, model.mesh.num_cells)
    # With 1,500 samples a deviation has an error of 2 %; none of some hundred cells exceeds four times this.
    np.testing.assert_allclose(drawn.std(axis=0), np.sqrt(diagonal(shapes, inverse)), rtol=0.08)
    even = shapes.mean(axis=0)
    assert drawn.mean(axis=1).std() == pytest.approx(np.sqrt(even @ inverse @ even), rel=0.08)


@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_steps_equal_those_of_the_whole_matrix(damping, image):
    """Steps to the minimum of the linearised misfit and of the quadratic model of the energy, weighted with 1 +
    damping."""
    inversion, point = on_host((image.inversion, image.coefficients))
    point = point + 0.05 * np.random.default_rng(0).normal(size=point.shape)
    residual, jacobian = inversion.linearise(point)
    form, gradient = precision(inversion, point)[0], np.asarray(jax.jit(jax.grad(inversion.penalty.cost))(point))
    matrix = jacobian.T @ inversion.data.precision @ jacobian + (1 + damping) * form
    expected = -np.linalg.solve(matrix, jacobian.T @ inversion.data.precision @ residual + gradient)
    direction, _, curvature = inversion.quadratic_model(point)[1](damping)
    np.testing.assert_allclose(direction, expected, rtol=0, atol=1e-8 * abs(expected).max())
    undamped = matrix - damping * form
    assert curvature == pytest.approx(expected @ undamped @ expected, rel=1e-8)


@pytest.mark.slow
def test_deviations_can_be_traced_and_differentiated():
    """Traced in one compiled program they are equal, and their derivative equals differences."""
    model = sheet()
    voltages = model.voltages(np.where(inside(model), 0.5, 1.0))

    def deviation(scale):
        found = reconstruct(
            model, scale * voltages, 1.0, prior=TotalVariation(0.1), hyperparameter=100.0,
            noise=1e-2 * jnp.abs(voltages), solver=LevenbergMarquardt(200, 1e-12),
        )  # fmt: skip
        return jnp.sum(posterior(found).standard_deviation()[:20])

    value, slope = jax.jvp(deviation, (1.0,), (1.0,))
    ahead, behind = deviation(1 + 1e-4), deviation(1 - 1e-4)
    assert value == pytest.approx(float(deviation(1.0)), rel=1e-6)
    assert slope == pytest.approx(float(ahead - behind) / 2e-4, rel=1e-3)


def test_bounds_leave_no_normal_posterior():
    found = sharp(sheet())
    held = TotalVariation().penalty(found.inversion.model.mesh, found.inversion.reference, 300.0, per_cell=True)[1]
    with pytest.raises(ValueError, match="unbounded solvers"):
        posterior(eqx.tree_at(lambda result: result.inversion.penalty, found, held))
