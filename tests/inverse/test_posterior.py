"""Posterior uncertainty against dense algebra and by simulation, and invalid input."""

import jax
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, Imager, Laplace, Noser, Parametrisation, posterior, reconstruct
from jeit.inverse.nonlinear import Background, GaussNewton
from jeit.layout import ring
from jeit.mesh import Disk, centroids, measures
from jeit.protocol import adjacent

LENGTH = 0.04


@pytest.fixture(scope="module")
def model():
    electrodes = BoundaryElectrodes(ring(0.1, 16), 0.012, 1e-3)
    return ForwardModel(Disk(0.1).mesh(num_points=300), electrodes, adjacent(16))


@pytest.fixture(scope="module")
def noise(model):
    return noise_of(model)


@pytest.fixture(scope="module")
def small():
    """A model with eight electrodes and 60 nodes, which compiles in half of the time."""
    electrodes = BoundaryElectrodes(ring(0.1, 8), 0.012, 1e-3)
    return ForwardModel(Disk(0.1).mesh(num_points=60), electrodes, adjacent(8))


def noise_of(model):
    return 1e-2 * np.abs(np.asarray(model.voltages(1.0)))


def press(model):
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.03, 0.02], axis=1) < 0.03
    return np.asarray(model.voltages(np.where(inside, 0.6, 1.0)))


@pytest.mark.parametrize(
    "prior",
    [pytest.param(Gaussian(LENGTH), marks=pytest.mark.slow), pytest.param(Laplace(), marks=pytest.mark.slow), Noser()],
    ids=["gaussian", "laplace", "noser"],
)
def test_against_dense_algebra(prior, small):
    result = reconstruct(small, press(small), 1.0, prior=prior, noise=noise_of(small), hyperparameter=2.0)
    found = posterior(result)
    inversion = result.inversion
    _, jacobian = inversion.linearise(result.coefficients)
    seen = np.asarray(inversion.data.whiten(jacobian))
    covariance = np.linalg.inv(seen.T @ seen + np.eye(seen.shape[1]))
    shapes = np.stack([np.asarray(inversion.basis.expand(one)) for one in np.eye(seen.shape[1])], axis=1)
    values = np.asarray(result.conductivity)
    expected = values * np.sqrt(np.einsum("ij,jk,ik->i", shapes, covariance, shapes))
    np.testing.assert_allclose(found.standard_deviation(), expected, rtol=1e-6)
    cells = np.asarray(centroids(small.mesh))[:, 0] > 0.02
    weight = np.where(cells, measures(small.mesh), 0)
    weight = weight / weight.sum()
    mean, deviation = found.region(cells)
    assert mean == pytest.approx(weight @ values, rel=1e-12)
    row = (weight * values) @ shapes
    assert deviation == pytest.approx(np.sqrt(row @ covariance @ row), rel=1e-6)


@pytest.mark.slow
def test_credible_intervals_and_samples(model, noise):
    options = {"prior": Gaussian(LENGTH), "noise": noise, "hyperparameter": 3.0}
    options["parametrisation"] = Parametrisation(unknowns=[Background(0.2)])
    found = posterior(reconstruct(model, press(model), 1.0, **options))
    lower, upper = found.credible_interval(0.9)
    assert (np.asarray(lower) > 0).all()
    drawn = found.sample(jax.random.key(1), 400)
    inside = ((drawn >= lower) & (drawn <= upper)).mean()
    assert inside == pytest.approx(0.9, abs=0.02)
    spread = np.std(np.log(drawn), axis=0)
    np.testing.assert_allclose(
        spread, found.standard_deviation() / found.inversion.conductivity(found.coefficients), rtol=0.25
    )
    assert 0 < float(found.unknowns()["Background"][0]) < 0.2


@pytest.mark.slow
def test_intervals_cover_the_truth_at_the_nominal_rate(model, noise):
    """200 bodies drawn from the prior, with noise: intervals contain the truth at the stated rate within 5 percentage
    points."""
    scale = 5.0  # standard deviation 0.2 of log σ
    imager = Imager.create(
        model, 1.0, prior=Gaussian(LENGTH), noise=noise, hyperparameter=scale,
        solver=GaussNewton(max_steps=8, rtol=1e-6), parametrisation=Parametrisation(informative=0.0),
    )  # fmt: skip
    inversion = imager.inversion
    weighing = imager.weighing(imager.mask)
    result = reconstruct(model, model.voltages(1.0), 1.0, prior=Gaussian(LENGTH), noise=noise, hyperparameter=scale)
    region = np.linalg.norm(np.asarray(centroids(model.mesh)), axis=1) < 0.03
    area = np.where(region, measures(model.mesh), 0)
    area = area / area.sum()
    held, held_regions = {0.5: [], 0.95: []}, []
    for number in range(200):
        body, error = jax.random.split(jax.random.key(number))
        truth = inversion.conductivity(jax.random.normal(body, (inversion.num_coefficients,)))
        frame = model.voltages(truth) + noise * jax.random.normal(error, noise.shape)
        estimate = imager.estimate(frame, weighing, imager.start)
        assert estimate.converged
        at = type(result)(**{**vars(result), "coefficients": estimate.coefficients})
        found = posterior(at)
        for probability, record in held.items():
            lower, upper = found.credible_interval(probability)
            record.append(float(((truth >= lower) & (truth <= upper)).mean()))
        mean, deviation = found.region(region)
        held_regions.append(abs(area @ np.asarray(truth) - mean) < 1.96 * deviation)
    for probability, record in held.items():
        assert np.mean(record) == pytest.approx(probability, abs=0.05)
    assert np.mean(held_regions) == pytest.approx(0.95, abs=0.05)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda found: found.credible_interval(1.0), "between 0 and 1"),
        (lambda found: found.region(np.zeros(found.inversion.model.mesh.num_cells, bool)), "none is chosen"),
        (lambda found: found.region([10**6]), "indices from 0"),
        (lambda found: found.region(np.ones(3, bool)), "booleans"),
        (lambda found: found.region([0.5]), "booleans"),
    ],
)
def test_bad_input(ask, message, small):
    solver, noise = GaussNewton(max_steps=2), noise_of(small)
    found = posterior(reconstruct(small, press(small), 1.0, prior=Noser(), noise=noise, solver=solver))
    with pytest.raises(ValueError, match=message):
        ask(found)
