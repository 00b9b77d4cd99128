"""Matérn fields: correlation against the closed form, uniform variances, and images with them as prior."""

import numpy as np
import pytest
from scipy.special import kv

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import one_step, posterior, reconstruct
from jeit.inverse.prior import priors
from jeit.inverse.prior.linear_algebra import GriddedGaussian
from jeit.inverse.prior.matern import Matern
from jeit.inverse.prior.priors import Gaussian, Laplace
from jeit.layout import ring
from jeit.mesh import box, centroids, disk
from jeit.mesh.mesh import interior_facets
from jeit.protocol import adjacent


def covariance(mesh, length):
    """Covariances of the cell nearest to the middle with all cells, and the distances to it."""
    centre = np.asarray(centroids(mesh))
    distance = np.linalg.norm(centre - centre.mean(axis=0), axis=1)
    middle = distance.argmin()
    one = np.zeros((1, mesh.num_cells))
    one[0, middle] = 1
    found = np.asarray(Matern(length).covariance_product(mesh, one))[:, 0]
    return found, np.linalg.norm(centre - centre[middle], axis=1)


def test_correlation_in_a_sheet_equals_the_closed_form():
    """κr K₁(κr) from a third of the length to twice the length, within 3 %; with cells half as large, half of that."""
    worst = []
    for number in (700, 2800):
        found, distance = covariance(disk(1.0, num_points=number), 0.25)
        scaled = np.sqrt(2) * distance / 0.25
        there = (scaled > 0.4) & (scaled < 3)
        worst.append(np.abs(found[there] - scaled[there] * kv(1, scaled[there])).max())
    assert worst[1] < 0.03
    assert worst[1] < 0.6 * worst[0]


def test_correlation_in_a_solid_equals_the_closed_form():
    """exp(-κr), from half the length to twice the length, on average within 2 %."""
    found, distance = covariance(box(1.0, 1.0, 1.0, num_points=2800), 0.25)
    scaled = distance / 0.25
    there = (scaled > 0.5) & (scaled < 2)
    assert np.abs(found[there] - np.exp(-scaled[there])).mean() < 0.02


def test_variance_is_uniform_up_to_the_wall():
    mesh = disk(1.0, num_points=1500)
    variance = np.sum(np.asarray(Matern(0.25).basis(mesh, np.zeros((0, 0))).shapes) ** 2, axis=1)
    assert 0.9 < variance.min() < variance.max() < 1.0


def test_estimated_variances_approximate_the_exact_ones(monkeypatch):
    mesh = disk(1.0, num_points=600)
    exact = Matern(0.25)._field(mesh, 0.0)
    monkeypatch.setattr("jeit.inverse.prior.matern._MAX_EXACT_NODES", 10)
    assert np.asarray(Matern(0.25)._field(mesh, 0.0).scale) == pytest.approx(exact.scale, rel=0.15)


def test_basis_and_product_are_consistent():
    mesh = disk(1.0, num_points=300)
    rows = np.random.default_rng(0).normal(size=(3, mesh.num_cells))
    shapes = np.asarray(Matern(0.3).basis(mesh, rows).shapes)
    product = np.asarray(Matern(0.3).covariance_product(mesh, rows))
    np.testing.assert_allclose(product, shapes @ (shapes.T @ rows.T), rtol=1e-10)


@pytest.fixture(scope="module")
def model():
    electrodes = BoundaryElectrodes(ring(0.1, 16), 0.012, 1e-3)
    return ForwardModel(disk(0.1, num_points=400), electrodes, adjacent(16))


def imaged(model):
    centre = np.asarray(centroids(model.mesh))
    target = np.array([0.04, 0.01])
    body = np.where(np.linalg.norm(centre - target, axis=1) < 0.02, 1.5, 1.0)
    return centre, target, np.asarray(model.voltages(body)), np.asarray(model.voltages(1.0))


def test_images_show_a_body_at_its_position(model):
    centre, target, after, before = imaged(model)
    change = np.asarray(one_step(model, 1.0, prior=Matern(0.02)).image(after - before))
    assert np.linalg.norm(centre[change.argmax()] - target) < 0.015
    found = reconstruct(model, after, 1.0, prior=Matern(0.02), hyperparameter=1.0, noise=1e-3 * np.abs(before).max())
    assert np.linalg.norm(centre[np.asarray(found.conductivity).argmax()] - target) < 0.015


# All basis functions of a Gaussian omit a thousandth of its variance, which is a fifth of the narrowest error bars.
@pytest.mark.parametrize(
    ("prior", "least"),
    [
        (Gaussian(0.02), None),
        pytest.param(Gaussian(0.02), 0.25, marks=pytest.mark.slow),
        (Matern(0.02), 0.05),
    ],
)
def test_fewer_basis_functions_give_the_same_image(prior, least, monkeypatch):
    """Images within 3 % of those with all basis functions, and error bars: components without information keep their
    variance."""
    model = ForwardModel(disk(0.1, num_points=120), BoundaryElectrodes(ring(0.1, 8), 0.012, 1e-3), adjacent(8))
    _, _, after, before = imaged(model)

    def found():
        noise = 1e-3 * np.abs(before).max()
        one = reconstruct(model, after, 1.0, prior=prior, hyperparameter=1.0, noise=noise)
        bars = 1.0 if least is None else posterior(one).standard_deviation()  # compiled for seconds
        return np.asarray(one.conductivity) - 1, np.asarray(bars)

    image, deviation = found()
    monkeypatch.setattr(priors, "_LARGE_MESH_CELLS", 10)
    monkeypatch.setattr(GriddedGaussian, "is_efficient", staticmethod(lambda places, length: True))
    few, bars = found()
    assert np.abs(few - image).max() < 0.03 * np.abs(image).max()
    assert np.abs(bars / deviation - 1).max() < (least or 1.0)


def test_gaussian_prior_by_a_grid():
    mesh = box(1.0, 1.0, 1.0, num_points=1500)
    centre = np.asarray(centroids(mesh))
    rows = np.random.default_rng(0).normal(size=(4, mesh.num_cells))
    exact = np.asarray(Gaussian(0.3).covariance_product(mesh, rows))
    about = GriddedGaussian(centre, 0.3).product(rows.T)
    assert np.abs(about - exact).max() < 5e-3 * np.abs(exact).max()


def test_a_grid_with_more_points_than_cells_is_still_faster():
    """A cylinder has fewer cells than its bounding box has grid points, but far more pairs of cells."""
    mesh = box(1.0, 1.0, 1.0, num_points=1500)
    centre = np.asarray(centroids(mesh))
    assert GriddedGaussian.is_efficient(centre, 0.14)
    assert np.prod(3 / 0.14 * np.ptp(centre, axis=0) + 5) > mesh.num_cells
    assert not GriddedGaussian.is_efficient(centre, 0.05)


def test_results_do_not_depend_on_the_number_of_columns():
    centre = np.random.default_rng(2).uniform(size=(300, 3))
    columns = np.random.default_rng(3).normal(size=(300, 130))
    grid = GriddedGaussian(centre, 0.4)
    alone = np.stack([grid.product(one[:, None])[:, 0] for one in columns.T], axis=1)
    np.testing.assert_allclose(grid.product(columns), alone, rtol=1e-10, atol=1e-10)


def test_laplace_prior_of_many_cells_is_defined_on_nodes(monkeypatch):
    """Γ is symmetric, positive and smooth: applied to white noise it keeps a small fraction of the jumps between
    cells."""
    mesh = box(1.0, 1.0, 1.0, num_points=300)
    rows = np.random.default_rng(1).normal(size=(2, mesh.num_cells))
    monkeypatch.setattr(priors, "_LARGE_MESH_CELLS", 10)
    product = np.asarray(Laplace().covariance_product(mesh, rows))
    inner = rows @ product
    assert inner[0, 1] == pytest.approx(inner[1, 0], rel=1e-9)
    assert (np.linalg.eigvalsh((inner + inner.T) / 2) > 0).all()
    first, second = interior_facets(mesh)[0].T
    steps = (product[first] - product[second]).std() / product.std()
    assert steps < 0.3


def test_bad_lengths_are_refused():
    for length in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="length"):
            Matern(length)
    with pytest.raises(ValueError, match="precision"):
        Matern(0.1).precision(disk(1.0, num_points=60), np.zeros((0, 0)))
