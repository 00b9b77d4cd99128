"""Nonlinear reconstructions of bodies simulated on another, finer mesh: every solver with every prior and link."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import (
    Gaussian,
    Laplace,
    Noser,
    Parametrisation,
    Tikhonov,
    TotalVariation,
    posterior,
    reconstruct,
)
from jeit.inverse.hyperparameter.rules import noise_figure
from jeit.inverse.nonlinear import (
    LBFGSB,
    Background,
    Bounded,
    ContactImpedance,
    ElectrodePosition,
    GaussNewton,
    LevenbergMarquardt,
    Linear,
    Log,
    ProjectedGradient,
)
from jeit.inverse.nonlinear.solvers import SOLVERS, LeastSquares, as_solver
from jeit.layout import ring
from jeit.mesh import Disk, Refine, centroids, measures
from jeit.protocol import adjacent

RADIUS = 0.1
CENTRE, INCLUSION = np.array([0.03, 0.02]), 0.025
ELECTRODES = BoundaryElectrodes(ring(RADIUS, 16), 0.012, 1e-3)


def model_of(num_points):
    mesh = Disk(RADIUS).mesh(num_points=num_points, refine=Refine(np.asarray(ELECTRODES.position), factor=2.0))
    return ForwardModel(mesh, ELECTRODES, adjacent(16, current=1e-3))


@pytest.fixture(scope="module")
def model():
    return model_of(400)


@pytest.fixture(scope="module")
def frame():
    """Voltages of a disk with an inclusion of three times its conductivity, with noise of 0.1 %, and this noise."""
    fine = model_of(1500)
    inside = np.linalg.norm(centroids(fine.mesh) - CENTRE, axis=1) < INCLUSION
    voltages = np.asarray(fine.voltages(np.where(inside, 3.0, 1.0)))
    noise = 1e-3 * np.abs(voltages)
    return voltages + noise * np.random.default_rng(0).normal(size=voltages.shape), noise


def contrast_and_centroid(model, conductivity):
    """Mean conductivity in the inclusion, and centroid of the cells that exceed half of the change."""
    position, weight = np.asarray(centroids(model.mesh)), np.asarray(measures(model.mesh))
    values = np.asarray(conductivity)
    inside = np.linalg.norm(position - CENTRE, axis=1) < 0.8 * INCLUSION
    raised = weight * np.maximum(values - (1 + values.max()) / 2, 0)
    return weight[inside] @ values[inside] / weight[inside].sum(), raised @ position / raised.sum()


@pytest.mark.parametrize("solver", ["gauss-newton", "levenberg-marquardt"])
@pytest.mark.parametrize("rule", ["discrepancy", "gcv"])
@pytest.mark.parametrize("prior", [Gaussian(0.02), Laplace()], ids=["gaussian", "laplace"])
def test_contrast_and_position_of_an_inclusion(solver, rule, prior, model, frame):
    voltages, noise = frame
    result = reconstruct(model, voltages, 1.0, prior=prior, noise=noise, hyperparameter=rule, solver=solver)
    contrast, centroid = contrast_and_centroid(model, result.conductivity)
    assert result.status == "converged"
    assert result.iterations <= 8
    assert result.misfit < 1.6
    assert contrast == pytest.approx(3, rel=0.15)
    assert np.linalg.norm(centroid - CENTRE) < 0.03 * RADIUS
    assert (np.diff(result.costs) < 0).all()


@pytest.mark.parametrize("link", [Linear(), Log(), Bounded(0.5, 4.0)], ids=["linear", "log", "bounded"])
@pytest.mark.parametrize("prior", [Noser(), Tikhonov()], ids=["noser", "tikhonov"])
def test_every_link(link, prior, model, frame):
    voltages, noise = frame
    scale, solver = Parametrisation(link=link), GaussNewton(max_steps=60)
    result = reconstruct(model, voltages, 1.0, prior=prior, parametrisation=scale, noise=noise, solver=solver)
    _, centroid = contrast_and_centroid(model, result.conductivity)
    assert result.status == "converged"
    assert (np.asarray(result.conductivity) > 0).all()
    assert np.linalg.norm(centroid - CENTRE) < 0.15 * RADIUS
    if isinstance(link, Bounded):
        assert 0.5 < result.conductivity.min() < result.conductivity.max() < 4


def test_derivative_of_the_misfit():
    """By second-order Taylor remainders, and products with the Jacobian against automatic differentiation."""
    electrodes = BoundaryElectrodes(ring(RADIUS, 6), 0.012, 1e-3)
    model = ForwardModel(Disk(RADIUS).mesh(num_points=40), electrodes, adjacent(6))
    voltages = np.asarray(model.voltages(np.where(np.asarray(centroids(model.mesh))[:, 0] > 0.03, 2.0, 1.0)))
    noise = 1e-3 * np.abs(voltages)
    solver = GaussNewton(max_steps=1)
    inversion = reconstruct(model, voltages, 1.0, prior=Gaussian(0.03), noise=noise, solver=solver).inversion
    random = np.random.default_rng(1)
    point = 0.01 * random.normal(size=inversion.basis.num_coefficients)
    direction = random.normal(size=point.shape)
    misfit, jacobian = (np.asarray(part) for part in inversion.linearise(point))
    np.testing.assert_allclose(misfit, inversion.residual(point), rtol=1e-9, atol=1e-9)
    residual, tangent = jax.jit(lambda at: jax.jvp(inversion.residual, (at,), (direction,)))(point)
    np.testing.assert_allclose(residual, misfit, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(jacobian @ direction, tangent, rtol=1e-8, atol=1e-8 * np.abs(tangent).max())
    steps = 1e-2 * 0.5 ** np.arange(4)
    errors = [
        np.linalg.norm(np.asarray(inversion.residual(point + h * direction)) - misfit - h * tangent) for h in steps
    ]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2, abs=0.1)


@pytest.fixture(scope="module")
def tiny():
    """Model, voltages and noise of five electrodes and 16 nodes, because solvers of optimistix take seconds to
    compile."""
    electrodes = BoundaryElectrodes(ring(RADIUS, 5), 0.012, 1e-3)
    model = ForwardModel(Disk(RADIUS).mesh(num_points=16), electrodes, adjacent(5))
    voltages = np.asarray(model.voltages(np.where(np.asarray(centroids(model.mesh))[:, 0] > 0.03, 2.0, 1.0)))
    return model, voltages, {"prior": Gaussian(0.05), "noise": 1e-3 * np.abs(voltages), "hyperparameter": 100.0}


@pytest.mark.slow
def test_solvers_of_optimistix_report_too_few_steps(tiny):
    model, voltages, options = tiny
    few = LeastSquares(optx.LevenbergMarquardt(1e-9, 1e-9), max_steps=2)
    assert reconstruct(model, voltages, 1.0, solver=few, **options).status == "step limit"


@pytest.mark.slow
def test_solvers_of_optimistix_that_stagnate_by_rounding_have_converged(tiny):
    """A tolerance near the square root of the precision may or may not be reached, but a single step must not pass. The
    image is that of Gauss-Newton."""
    model, voltages, options = tiny
    solver = optx.LevenbergMarquardt(1e-9, 1e-9)
    ours = reconstruct(model, voltages, 1.0, solver=GaussNewton(rtol=1e-12), **options)
    for rounding in range(4):
        result = reconstruct(model, voltages * (1 + rounding * 1e-15), 1.0, solver=solver, **options)
        assert result.status == "converged"
        np.testing.assert_allclose(result.conductivity, ours.conductivity, rtol=1e-3)


def test_a_warm_start_needs_fewer_steps(model, frame):
    voltages, noise = frame
    options = {"prior": Gaussian(0.02), "noise": noise, "hyperparameter": "discrepancy"}
    cold = reconstruct(model, voltages, 1.0, **options)
    warm = reconstruct(model, voltages, 1.0, start=cold, **options)
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.conductivity, cold.conductivity, rtol=1e-2)


def test_masked_channels_are_ignored(model, frame):
    voltages, noise = frame
    mask = np.ones(208, bool)
    mask[3::20] = False
    incomplete = np.where(mask, voltages, np.nan)
    result = reconstruct(model, incomplete, 1.0, prior=Gaussian(0.02), noise=noise, mask=mask, hyperparameter="gcv")
    _, centroid = contrast_and_centroid(model, result.conductivity)
    assert result.status == "converged"
    assert np.linalg.norm(centroid - CENTRE) < 0.03 * RADIUS


def test_too_few_steps_are_reported(model, frame):
    voltages, noise = frame
    result = reconstruct(model, voltages, 1.0, prior=Gaussian(0.02), noise=noise, solver=GaussNewton(max_steps=2))
    assert result.status == "step limit"
    assert result.iterations == 2
    assert "after 2 iterations;" in result.reason


@pytest.mark.parametrize("solver", [GaussNewton(), LevenbergMarquardt()])
def test_voltages_of_the_background_are_at_the_minimum(model, solver):
    """Their objective is zero, so that no step is small relative to it."""
    result = reconstruct(model, model.voltages(1.0), 1.0, prior=Gaussian(0.02), hyperparameter=3.0, solver=solver)
    assert result.status == "converged"
    assert result.iterations <= 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"voltages": np.zeros(208)}, "current source"),
        ({"voltages": np.full(208, np.nan)}, "NaN"),
        ({"voltages": np.ones(96)}, "208 channels"),
        ({"mask": np.zeros(208, bool)}, "every channel"),
        ({"mask": np.ones(208)}, "booleans"),
        ({"noise": 0.0}, "noise"),
        ({"background": -1.0}, "background"),
        ({"background": 5.0, "parametrisation": Parametrisation(link=Bounded(0.5, 4.0))}, "between 0.5 and 4"),
        ({"background": np.ones(3)}, "cells"),
        ({"background": 1 + 0.1j}, "real conductivity"),
        ({"voltages": (1 + 0.1j) * np.ones(208)}, "complex"),
        ({"noise": np.ones(3)}, "each channel"),
        ({"prior": "noser"}, "Noser"),
        ({"solver": "newton"}, "gauss-newton"),
        ({"solver": "one-step"}, "those of one_step"),
        ({"solver": 3}, "such as GaussNewton"),
        ({"hyperparameter": "magic"}, "magic"),
        ({"hyperparameter": -1.0}, "positive"),
        ({"hyperparameter": noise_figure, "prior": TotalVariation()}, "takes a number"),
        ({"noise": 1e-4 + 1j}, "real number"),
        ({"noise": "small"}, "real number"),
        ({"start": "there"}, "what reconstruct has returned"),
    ],
)
def test_bad_input(change, message, model, frame):
    arguments = {"voltages": frame[0], "background": 1.0, "noise": frame[1], **change}
    with pytest.raises(ValueError, match=message):
        reconstruct(model, **arguments)


@pytest.mark.parametrize(
    ("make", "change", "message"),
    [
        (GaussNewton, {"rtol": np.inf}, "rtol"),
        (GaussNewton, {"rtol": -1.0}, "rtol"),
        (GaussNewton, {"rtol": np.nan}, "rtol"),
        (LevenbergMarquardt, {"rtol": "fine"}, "rtol"),
        (LevenbergMarquardt, {"damping": 0.0}, "damping"),
        (LBFGSB, {"tolerance": 1.0}, "tolerance"),
        (GaussNewton, {"max_steps": 0}, "max_steps"),
        (LevenbergMarquardt, {"max_steps": 2.5}, "max_steps"),
        (ProjectedGradient, {"max_steps": "3"}, "max_steps"),
        (Parametrisation, {"link": "log"}, "Log"),
        (Parametrisation, {"unknowns": [Background(), Background()]}, "more than once"),
        (Parametrisation, {"unknowns": Background()}, "list of those"),
        (Parametrisation, {"unknowns": [Background]}, "list of those"),
        (Parametrisation, {"informative": 1.5}, "informative"),
    ],
)
def test_bad_settings(make, change, message):
    """Invalid settings of a solver or a parametrisation are refused before there is a problem."""
    with pytest.raises(ValueError, match=message):
        make(**change)


def test_solvers_can_be_given_by_name():
    for name in SOLVERS:
        assert as_solver(name).name == name


def test_an_unknown_name_lists_the_suitable_ones():
    """Linear methods are not offered for reconstructions, and slow methods not for frames of a stream."""
    with pytest.raises(ValueError, match=r"^solver must be one of gauss-newton, levenberg-marquardt, l-bfgs"):
        as_solver("newton")
    with pytest.raises(ValueError, match="must be one of one-step, gauss-newton, levenberg"):
        as_solver("newton", frames=True)


def test_informative_basis_functions_hardly_change_an_image(model, frame):
    """Components without information in the data keep their prior values."""
    options = {"prior": Gaussian(0.02), "noise": frame[1], "hyperparameter": 30.0}
    every = reconstruct(model, frame[0], 1.0, **options)
    some = reconstruct(model, frame[0], 1.0, parametrisation=Parametrisation(informative=0.01), **options)
    assert some.coefficients.size < 0.75 * every.coefficients.size
    error = np.linalg.norm(some.conductivity - every.conductivity)
    assert error < 0.02 * np.linalg.norm(every.conductivity - 1)


def test_unknowns_of_another_model_are_refused(model, frame):
    electrodes = BoundaryElectrodes(ring(RADIUS, 8), 0.012, 1e-3)
    other = ForwardModel(model.mesh, electrodes, adjacent(8))
    for unknown in (ContactImpedance(other), ElectrodePosition(other, 1e-3)):
        with pytest.raises(ValueError, match="another model"):
            reconstruct(model, frame[0], 1.0, parametrisation=Parametrisation(unknowns=[unknown]))


def test_a_misfit_that_is_not_finite_is_a_failure(model, frame):
    """Even if the conductivity is finite; and further computations with it are refused."""
    result = reconstruct(model, frame[0], 1.0, noise=1e-300, hyperparameter=3.0, solver=GaussNewton(max_steps=2))
    assert result.status == "failed"
    with pytest.raises(ValueError, match="failed"):
        posterior(result)


def test_voltages_in_other_units_give_a_hint(model, frame):
    options = {"hyperparameter": 3.0, "solver": GaussNewton(max_steps=2)}
    result = reconstruct(model, 1e3 * frame[0], 1.0, noise=1e3 * frame[1], **options)
    assert result.status == "step limit"
    assert "times those of the background" in result.reason


def test_bounds_in_the_wrong_order():
    with pytest.raises(ValueError, match="lower < upper"):
        Bounded(2.0, 1.0)


def test_unexplained_data_increase_the_misfit(model, frame):
    result = reconstruct(model, -frame[0], 1.0, prior=Gaussian(0.02), noise=frame[1], hyperparameter=100.0)
    assert np.isfinite(np.asarray(result.conductivity)).all()
    assert result.misfit > 100


@pytest.mark.parametrize("given", [Log(), {"link": Log()}])
def test_other_objects_are_refused_as_parametrisation(model, frame, given):
    with pytest.raises(ValueError, match="such as Parametrisation"):
        reconstruct(model, frame[0], 1.0, parametrisation=given)


def test_a_start_from_another_problem_is_refused(model, frame):
    options = {"noise": frame[1], "hyperparameter": 100.0}
    other = reconstruct(model, frame[0], 1.0, prior=Gaussian(0.05), **options)
    with pytest.raises(ValueError, match="same model, prior and link"):
        reconstruct(model, frame[0], 1.0, prior=Gaussian(0.03), start=other, **options)


@pytest.mark.parametrize("link", [Linear(), Log(), Bounded(0.5, 4.0)], ids=["linear", "log", "bounded"])
def test_links_invert_and_differentiate(link):
    conductivity = jnp.linspace(0.6, 3.9, 12)
    estimate = link.estimate(conductivity)
    np.testing.assert_allclose(link.conductivity(estimate), conductivity, rtol=1e-13)
    slope = jax.vmap(jax.grad(link.conductivity))(estimate)
    np.testing.assert_allclose(link.slope(estimate), slope, rtol=1e-12)


@pytest.mark.parametrize(
    ("prior", "tolerance"),
    [(Tikhonov(), 1e-13), (Noser(), 1e-12), (Gaussian(0.03), 1e-2)],
    ids=["tik", "noser", "gauss"],
)
def test_a_basis_is_a_square_root_of_its_prior(prior, tolerance, model):
    """S Sᵀ Jᵀ = Γ Jᵀ; the low rank of the Gaussian omits a thousandth of the variance."""
    jacobian = model.jacobian(1.0)
    basis = prior.basis(model.mesh, jacobian)
    product = jax.vmap(basis.expand, in_axes=1, out_axes=1)(basis.restrict(jacobian).T)
    expected = prior.covariance_product(model.mesh, jacobian)
    assert np.linalg.norm(product - expected) < tolerance * np.linalg.norm(expected)
    doubled = basis.scaled(2.0).expand(jnp.ones(basis.num_coefficients))
    np.testing.assert_allclose(doubled, 2 * basis.expand(jnp.ones(basis.num_coefficients)), rtol=1e-13)


def test_the_laplace_basis_inverts_its_precision(model):
    """Sᵀ Q S = 1 except for the constant image, whose precision is a millionth."""
    prior, jacobian = Laplace(), model.jacobian(1.0)
    shapes = prior.basis(model.mesh, jacobian).shapes
    whitened = shapes.T @ (prior.precision(model.mesh, jacobian) @ np.asarray(shapes))
    eigenvalues = np.linalg.eigvalsh(whitened)
    assert abs(eigenvalues[0]) < 1e-6
    np.testing.assert_allclose(eigenvalues[1:], 1, atol=1e-3)


def test_conductivity_without_a_link_stays_positive(model):
    """A factorisation may succeed for negative values; steps that lead there are shortened all the same."""
    inclusion = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.02, 0.01], axis=1) < 0.02
    voltages = model.voltages(np.where(inclusion, 1e-4, 2.0))
    options = {"hyperparameter": 0.01, "parametrisation": Parametrisation(link=Linear())}
    result = reconstruct(model, voltages, 2.0, solver=GaussNewton(max_steps=8), **options)
    assert result.conductivity.min() > 0
