"""Parametrisations: cells that share a value, fixed cells, and pixels of a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, Noser, Parametrisation, reconstruct
from jeit.inverse.prior.bases import Regions, pixels
from jeit.layout import ring
from jeit.mesh import Disk, centroids, measures
from jeit.protocol import adjacent


@pytest.fixture(scope="module")
def model():
    electrodes = BoundaryElectrodes(ring(0.1, 16), 0.012, 1e-3)
    return ForwardModel(Disk(0.1).mesh(num_points=300), electrodes, adjacent(16))


def halves(model):
    """Left half, right half, and a known rim."""
    centre = np.asarray(centroids(model.mesh))
    label = np.where(centre[:, 0] < 0, 0, 1)
    return np.where(np.linalg.norm(centre, axis=1) > 0.07, -1, label)


@pytest.mark.parametrize("prior", [Noser(), Gaussian(0.03)], ids=["noser", "gaussian"])
def test_values_of_regions_are_estimated_and_fixed_cells_kept(prior, model):
    label = halves(model)
    truth = np.select([label == 0, label == 1], [0.5, 2.0], 1.0)
    voltages = model.voltages(truth)
    noise = 1e-4 * jnp.abs(voltages)
    shared = Parametrisation(regions=label)
    result = reconstruct(model, voltages, 1.0, prior=prior, noise=noise, hyperparameter=1e-3, parametrisation=shared)
    assert result.status == "converged"
    if isinstance(prior, Noser):
        assert result.inversion.basis.num_coefficients == 2
    np.testing.assert_allclose(result.conductivity, truth, rtol=2e-3)
    np.testing.assert_array_equal(result.conductivity[label == -1], 1.0)


def test_pixels_have_one_value_each(model):
    label = pixels(model.mesh, (6, 5))
    assert label.min() == 0
    assert label.max() < 30
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.03, 0.02], axis=1) < 0.03
    voltages = model.voltages(jnp.where(inside, 2.0, 1.0))
    noise = 1e-2 * jnp.abs(voltages)
    shared = Parametrisation(regions=label)
    result = reconstruct(model, voltages, 1.0, prior=Noser(), noise=noise, hyperparameter=1.0, parametrisation=shared)
    values = np.asarray(result.conductivity)
    assert all(np.ptp(values[label == k]) == 0 for k in range(label.max() + 1))
    assert values[inside].mean() > 1.3


@pytest.mark.parametrize("prior", [Noser(), Gaussian(0.03)], ids=["noser", "gaussian"])
def test_a_region_basis_and_its_adjoint(prior, model):
    """⟨rows, S c⟩ = ⟨rows S, c⟩, and the derivative of the problem equals automatic differentiation."""
    jacobian = model.jacobian(1.0)
    basis = prior.basis(model.mesh, jacobian).pooled(Regions.create(model.mesh, halves(model)))
    c = jax.random.normal(jax.random.key(0), (basis.num_coefficients,))
    np.testing.assert_allclose(basis.restrict(jacobian) @ c, jacobian @ basis.expand(c), rtol=1e-9, atol=1e-12)


def test_means_are_weighted_by_area(model):
    label = halves(model)
    regions = Regions.create(model.mesh, label)
    values, area = np.asarray(centroids(model.mesh))[:, 1], np.asarray(measures(model.mesh))
    expected = [area[label == k] @ values[label == k] / area[label == k].sum() for k in (0, 1)]
    np.testing.assert_allclose(regions.mean(jnp.asarray(values)), expected, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize(
    ("label", "message"),
    [
        (np.zeros(3, int), "one for each"),
        (np.full(551, -1), "integers"),
        (np.full(551, 0.5), "integers"),
        (np.full(551, 2), "no cell has the label 0"),
        (np.r_[np.zeros(550, int), 10**9], "more than there are cells"),
        (np.full(551, -2), "integers"),
    ],
)
def test_bad_input(label, message, model):
    assert model.mesh.num_cells == 551
    with pytest.raises(ValueError, match=message):
        reconstruct(model, model.voltages(1.0), 1.0, parametrisation=Parametrisation(regions=label))


def test_pixels_need_a_shape(model):
    with pytest.raises(ValueError, match="rows, columns"):
        pixels(model.mesh, (0, 4))
