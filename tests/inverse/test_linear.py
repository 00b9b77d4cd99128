"""Linear images: the matrix against its definition, hyperparameter rules, and images of simulated inclusions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.image import find_inclusions
from jeit.inverse import (
    RULES,
    Gaussian,
    Laplace,
    LinearReconstruction,
    Noser,
    Tikhonov,
    back_projection,
    calibrate,
    one_step,
)
from jeit.layout import ring
from jeit.mesh import centroids, disk
from jeit.protocol import adjacent

PRIORS = {"tikhonov": Tikhonov(), "laplace": Laplace(), "noser": Noser(), "gaussian": Gaussian(0.02)}


@pytest.fixture(scope="module")
def model():
    electrodes = BoundaryElectrodes(ring(0.1, 16), 0.02, 1e-3)
    return ForwardModel(disk(0.1, num_points=300), electrodes, adjacent(16, current=1e-3))


@pytest.fixture(scope="module")
def difference(model):
    """Difference voltages of an inclusion of double conductivity at (0.05, 0.02) m on a finer mesh, with relative noise
    of 1e-4."""
    fine = ForwardModel(disk(0.1, num_points=900), model.electrodes, model.protocol)
    inside = np.linalg.norm(np.asarray(centroids(fine.mesh)) - [0.05, 0.02], axis=1) < 0.02
    change = np.asarray(fine.voltages(np.where(inside, 2.0, 1.0))) - np.asarray(fine.voltages(1.0))
    noise = np.random.default_rng(3).normal(size=change.shape) * 1e-2 * np.abs(change).max()
    return change + noise


@pytest.mark.parametrize("name", ["tikhonov", "laplace", "noser"])
def test_matrix_solves_the_normal_equations(model, name):
    """(JᵀWJ + λ²Q) R = JᵀW, the definition, with unequal noise and a mask."""
    mask = np.ones(208, bool)
    mask[[3, 50]] = False
    noise = np.random.default_rng(0).uniform(0.5, 2, 208)
    reconstruction = one_step(model, 1.0, prior=PRIORS[name], hyperparameter=0.03, noise=noise, mask=mask)
    weight = np.where(mask, noise**-2, 0)
    jacobian = np.asarray(model.jacobian(1.0))
    whitened = np.sqrt(weight)[:, None] * jacobian
    precision = PRIORS[name].precision(model.mesh, whitened).toarray()
    normal = whitened.T @ whitened + 0.03**2 * precision
    matrix = np.asarray(reconstruction.matrix)
    right = jacobian.T * weight
    assert np.linalg.norm(normal @ matrix - right) < 1e-9 * np.linalg.norm(right)
    assert np.abs(matrix[:, ~mask]).max() == 0


def test_gaussian_matrix_equals_its_data_space_form(model):
    jacobian = np.asarray(model.jacobian(1.0))
    centre = np.asarray(centroids(model.mesh))
    covariance = np.exp(-((centre[:, None] - centre) ** 2).sum(axis=-1) / (2 * 0.02**2))
    expected = covariance @ jacobian.T @ np.linalg.inv(jacobian @ covariance @ jacobian.T + 0.3**2 * np.eye(208))
    matrix = np.asarray(one_step(model, 1.0, prior=PRIORS["gaussian"], hyperparameter=0.3).matrix)
    assert np.linalg.norm(matrix - expected) < 1e-9 * np.linalg.norm(expected)


def test_image_equals_the_full_matrix_for_one_frame_and_many(model, difference):
    reconstruction = one_step(model, 1.0, hyperparameter=0.03)
    assert reconstruction.weights.shape[0] == 104  # reciprocity halves 208 adjacent channels
    frames = np.stack([difference, 2 * np.roll(difference, 5)])
    images = reconstruction.image(frames)
    expected = frames @ np.asarray(reconstruction.matrix).T
    np.testing.assert_allclose(images, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(reconstruction.image(frames[0]), expected[0], atol=1e-12 * np.abs(expected).max())
    film = np.tile(frames, (1_100_000 // expected.nbytes + 1, 1))
    imaged, again = (reconstruction.image(sign * film) for sign in (1, -1))  # in memory that JAX takes over
    assert isinstance(imaged, jax.Array)
    assert imaged.nbytes > 1e6
    np.testing.assert_array_equal(imaged, -again)
    np.testing.assert_allclose(imaged[-2:], images, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("mixed", [False, True])
def test_the_noise_of_an_image_is_that_of_its_channels(model, mixed):
    reconstruction = one_step(model, 1.0, hyperparameter=0.03)
    if mixed:  # a matrix stored as two factors of rank three, by which 104 combined channels are reduced
        factors = np.random.default_rng(1).normal(size=(400, 3)), np.random.default_rng(2).normal(size=(3, 208))
        reconstruction = LinearReconstruction.of_factors(model, factors, 0.03, "given", "of factors")
        assert reconstruction.mixing is not None
    deviations = np.random.default_rng(0).uniform(1e-4, 1e-3, size=208)
    expected = np.sqrt((np.asarray(reconstruction.matrix) * deviations) ** 2 @ np.ones(208))
    np.testing.assert_allclose(reconstruction.image_noise(deviations), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="a voltage for each of 208"):
        reconstruction.image_noise(1e-3)


def test_images_are_equal_uncompiled_compiled_batched_and_of_a_traced_reconstruction(model, difference):
    reconstruction = one_step(model, 1.0, hyperparameter=0.03)
    expected = reconstruction.image(np.asarray(difference))
    assert isinstance(expected, jax.Array)
    traced = jax.jit(lambda held, voltages: held.image(voltages))(reconstruction, difference)
    doubled = jax.tree.map(lambda weights: jnp.stack([weights, weights]), reconstruction)
    images = {
        "compiled": jax.jit(reconstruction.image)(difference),
        "batched": jax.vmap(reconstruction.image)(jnp.stack([difference, difference]))[1],
        "traced": traced,
        "many reconstructions": jax.vmap(lambda held: held.image(difference))(doubled)[1],
        "after being traced": reconstruction.image(difference),
    }
    for name, image in images.items():
        np.testing.assert_allclose(image, expected, atol=1e-12 * np.abs(expected).max(), err_msg=name)


@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS.keys())
def test_every_prior_images_the_inclusion(model, difference, prior):
    image = one_step(model, 1.0, prior=prior, difference=difference).image(difference)
    strongest = find_inclusions(model.mesh, image)[0]
    assert strongest.sign == 1
    # Tikhonov regularisation shifts images towards the edge, where the sensitivity is largest.
    tolerance = 0.02 if isinstance(prior, Tikhonov) else 0.012
    assert np.linalg.norm(np.array(strongest.centroid) - [0.05, 0.02]) < tolerance


@pytest.mark.parametrize("filtered", [False, True])
def test_back_projection_images_the_inclusion(model, difference, filtered):
    image = back_projection(model, 1.0, filtered=filtered, hyperparameter=0.01).image(difference)
    strongest = find_inclusions(model.mesh, image)[0]
    assert strongest.sign == 1
    assert np.linalg.norm(np.array(strongest.centroid) - [0.05, 0.02]) < 0.03


def _calibrate(model, mask):
    return calibrate(model, np.ones(model.protocol.num_measurements), mask=mask)


@pytest.mark.parametrize("image", [lambda model, mask: back_projection(model, 1.0, mask=mask), _calibrate])
def test_a_mask_of_numbers_is_refused(image, model):
    """NaN would be taken for True."""
    with pytest.raises(ValueError, match=r"mask .*booleans"):
        image(model, np.full(model.protocol.num_measurements, np.nan))


def test_back_projection_of_a_uniform_change(model):
    change = model.voltages(1.01) - model.voltages(1.0)
    image = np.asarray(back_projection(model, 1.0).image(change))
    reached = image != 0
    assert reached.mean() > 0.9
    # z is constant while σ changes, so that voltages do not scale exactly.
    np.testing.assert_allclose(image[reached], 0.01, rtol=0.1)


@pytest.mark.parametrize("rule", RULES)
def test_chosen_hyperparameters_increase_with_the_noise(model, difference, rule):
    """Data in units of noise: with ten times the noise, rules that use the data must not choose a smaller λ."""
    chosen = []
    for level in (1e-2, 1e-1):
        scale = level * float(jnp.abs(difference).max())
        noise = scale * np.random.default_rng(4).normal(size=208)
        quiet = one_step(model, 1.0, hyperparameter=rule, difference=difference + noise, noise=scale)
        chosen.append(float(quiet.hyperparameter) * scale)
        assert quiet.rule == rule
    if rule != "noise-figure":
        assert chosen[1] > chosen[0]


def test_discrepancy_leaves_the_noise_in_the_residual(model, difference):
    scale = 0.05 * float(jnp.abs(difference).max())
    noisy = difference + scale * np.random.default_rng(5).normal(size=208)
    reconstruction = one_step(model, 1.0, hyperparameter="discrepancy", difference=noisy, noise=scale)
    residual = noisy - model.jacobian(1.0) @ reconstruction.image(noisy)
    assert float(jnp.sum(residual**2)) / scale**2 == pytest.approx(208, rel=0.1)
