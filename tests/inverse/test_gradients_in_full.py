"""Gradients of every kind of image in all that has one, electrodes and nodes too, against finite differences on a mesh
that is fine enough for them; batches against loops, compiled code against what NumPy answers at once."""

from typing import Any

import equinox as eqx
import image_slopes
import jax
import jax.numpy as jnp
import numpy as np
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
    calibrate,
    choose_hyperparameter,
    one_step,
    posterior,
    reconstruct,
)
from jeit.inverse.nonlinear import (
    LBFGSB,
    ContactImpedance,
    ElectrodePosition,
    GaussNewton,
    LevenbergMarquardt,
    Scale,
)
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent

pytestmark = pytest.mark.slow  # test_image_gradients.py has one of each kind, on a small body

ANGLE = 2 * np.pi * np.arange(8) / 8 + 0.13  # no end of an electrode on a node, where derivatives jump
ELECTRODES = BoundaryElectrodes(0.1 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1), 0.02, 1e-2)
MESH = Disk(0.1).mesh(num_points=80)
MODEL: Any = ForwardModel(MESH, ELECTRODES, adjacent(8, current=1e-3))
RANDOM = np.random.default_rng(5)
WEIGHT: Any = RANDOM.normal(size=MESH.num_cells)
INSIDE = np.linalg.norm(np.asarray(centroids(MESH)) - [0.03, 0.02], axis=1) < 0.04
EMPTY: Any = np.asarray(MODEL.voltages(1e-3))
FRAME: Any = np.asarray(MODEL.voltages(np.where(INSIDE, 1.5e-3, 1e-3))) * (1 + 2e-3 * RANDOM.normal(size=EMPTY.shape))
THETA: dict[str, Any] = {
    "data": FRAME,
    "background": 1e-3 * (1 + 0.1 * RANDOM.random(MESH.num_cells)),
    "noise": 1e-2 * np.abs(EMPTY) * (1 + RANDOM.random(EMPTY.shape)),
    "position": np.asarray(ELECTRODES.position),
    "points": np.asarray(MESH.points),
}
# Of the steps of differences: channels, cells, noise relative to themselves, electrodes and points in metres.
SIZE = {"data": 0.01 * EMPTY, "background": 1e-3, "noise": THETA["noise"], "position": 1e-2, "points": 1e-3}


def placed(theta):
    """The model with electrodes and points of the mesh where `theta` has them."""
    moved = MODEL.with_electrodes(eqx.tree_at(lambda e: e.position, MODEL.electrodes, theta["position"]))
    return eqx.tree_at(lambda m: m.mesh.points, moved, theta["points"])


def assert_gradient(function, theta, **settings):
    image_slopes.assert_gradient(function, theta, SIZE, **settings)


@pytest.mark.parametrize("prior", [Noser(), Laplace(), Gaussian(0.03), Tikhonov()], ids=lambda p: type(p).__name__)
def test_linear_images(prior):
    level = choose_hyperparameter(MODEL, 1e-3, prior=prior, noise=THETA["noise"]).hyperparameter
    settings = {"hyperparameter": level} | ({"length": 0.03} if isinstance(prior, Gaussian) else {})

    def image(theta):
        chosen = Gaussian(theta["length"]) if isinstance(prior, Gaussian) else prior
        linear = one_step(
            placed(theta),
            theta["background"],
            prior=chosen,
            hyperparameter=theta["hyperparameter"],
            noise=theta["noise"],
        )
        return 1e3 * WEIGHT @ linear.image(theta["data"] - EMPTY)

    assert_gradient(image, THETA | settings)


def solved(theta, prior, solver, parametrisation=None):
    """The reconstruction of everything in `theta`."""
    return reconstruct(
        placed(theta),
        theta["data"],
        theta.get("background", THETA["background"]),
        prior=prior,
        hyperparameter=theta["hyperparameter"],
        noise=theta["noise"],
        solver=solver,
        parametrisation=parametrisation,
    )


def image_of(found):
    """A number that depends on every cell, on the misfit and on the predicted voltages."""
    return 1e3 * WEIGHT @ found.conductivity + found.misfit + 1e3 * jnp.sum(found.voltages**2) + found.costs[-1]


TIGHT = GaussNewton(max_steps=100, rtol=1e-16)


def test_nonlinear_image():
    assert_gradient(lambda theta: image_of(solved(theta, Noser(), TIGHT)), THETA | {"hyperparameter": 10.0})


@pytest.mark.parametrize("prior", [Gaussian(0.03), Laplace()], ids=lambda p: type(p).__name__)
def test_nonlinear_images_of_smooth_priors(prior):
    settings = {"hyperparameter": 3.0} | ({"length": 0.03} if isinstance(prior, Gaussian) else {})

    def image(theta):
        chosen = Gaussian(theta["length"]) if isinstance(prior, Gaussian) else prior
        return image_of(solved(theta, chosen, LevenbergMarquardt(max_steps=100, rtol=1e-17)))

    assert_gradient(image, THETA | settings)


def test_images_of_total_variation():
    """The smoothed energy's own optimality condition, not the forms that touch it. The background all but drops out."""
    assert_gradient(
        lambda theta: image_of(solved(theta, TotalVariation(0.3), GaussNewton(max_steps=1000, rtol=1e-16))),
        {name: value for name, value in THETA.items() if name != "background"} | {"hyperparameter": 3.0},
    )


def test_images_between_bounds():
    """Cells at a bound stay there, and move with it."""

    def found(theta):
        within = Parametrisation(bounds=(0.9e-3, theta["upper"]))
        return solved(theta, Noser(), LBFGSB(max_steps=5000, tolerance=1e-13), within)

    theta = THETA | {"hyperparameter": 3.0, "upper": 1.25e-3}
    conductivity = np.asarray(found(theta).conductivity)
    at_bound = np.isclose(conductivity, 1.25e-3, rtol=1e-9) | np.isclose(conductivity, 0.9e-3, rtol=1e-9)
    assert 3 <= at_bound.sum() <= len(conductivity) - 3
    assert_gradient(lambda theta: 1e3 * WEIGHT @ found(theta).conductivity, theta)


def test_images_with_further_unknowns():
    unknowns = [ContactImpedance(MODEL, 0.1), ElectrodePosition(MODEL, 3e-4), Scale(0.03)]

    def image(theta):
        found = solved(theta, Noser(), TIGHT, Parametrisation(unknowns=unknowns))
        return image_of(found) + 1e3 * jnp.sum(found.model.electrodes.contact_impedance)

    assert_gradient(image, THETA | {"hyperparameter": 10.0})


def test_uncertainties():
    def deviation(theta):
        around = posterior(solved(theta, Noser(), TIGHT))
        return 1e3 * WEIGHT @ around.standard_deviation() + 1e3 * around.region(np.flatnonzero(INSIDE))[1]

    theta = THETA | {"hyperparameter": 10.0}
    assert_gradient(deviation, theta)


@pytest.mark.parametrize("contact", ["common", "each"])
def test_calibrations(contact):
    apart = ELECTRODES.with_contact_impedance(np.linspace(0.2, 0.5, 8))
    wide = MODEL.with_electrodes(ELECTRODES.with_contact_impedance(np.full(8, 0.3)))
    data = MODEL.with_electrodes(apart).voltages(2e-3) * (1 + 1e-3 * np.random.default_rng(2).normal(size=EMPTY.shape))

    def fitted(theta):
        moved = wide.with_electrodes(eqx.tree_at(lambda e: e.position, wide.electrodes, theta["position"]))
        model = eqx.tree_at(lambda m: m.mesh.points, moved, theta["points"])
        found = calibrate(model, theta["data"], contact=contact)
        impedance = found.model.electrodes.contact_impedance @ np.arange(1.0, 9.0)
        return 1e3 * found.conductivity + impedance + 1e2 * found.misfit + found.contact_deviation.sum()

    theta = {name: THETA[name] for name in ("position", "points")} | {"data": data}
    assert_gradient(fitted, theta, equal=1e-6, compiled=True)  # at once it ends where parameters change by 1e-8


def test_batches_of_frames():
    frames = np.stack([FRAME, 0.9 * FRAME, 0.5 * (FRAME + EMPTY)])

    def linear(frame):
        return one_step(MODEL, 1e-3, hyperparameter=30.0, noise=0.01 * jnp.abs(frame)).image(frame - EMPTY)

    def nonlinear(frame):
        found = reconstruct(MODEL, frame, 1e-3, prior=Gaussian(0.03), hyperparameter=3.0)
        return found.conductivity, found.misfit, found.outcome, found.iterations

    one_by_one = jnp.stack([linear(frame) for frame in frames])
    np.testing.assert_allclose(jax.vmap(linear)(frames), one_by_one, rtol=0, atol=1e-9 * float(abs(one_by_one).max()))
    batch: Any = jax.vmap(nonlinear)(frames)
    for index, frame in enumerate(frames):
        for together, alone in zip(batch, nonlinear(frame), strict=True):
            np.testing.assert_allclose(together[index], alone, rtol=1e-8)


def test_gradients_of_batches_are_batches_of_gradients():
    frames = np.stack([FRAME, 1.1 * FRAME])

    def value(frame):
        found = reconstruct(MODEL, frame, 1e-3, prior=Gaussian(0.04), hyperparameter=3.0, noise=0.01 * np.abs(EMPTY))
        return 1e3 * WEIGHT @ found.conductivity

    gradient = jax.jit(jax.grad(value))
    together = jax.vmap(jax.grad(value))(frames)
    np.testing.assert_allclose(together, np.stack([gradient(frame) for frame in frames]), rtol=1e-7)


def test_derivatives_are_the_minimum_s_however_early_the_solver_stopped():
    def value(frame, solver):
        found = reconstruct(
            MODEL, frame, 1e-3, prior=Gaussian(0.04), hyperparameter=1.0, noise=0.01 * np.abs(EMPTY), solver=solver
        )
        return found.coefficients @ np.arange(found.coefficients.size)

    early, late = GaussNewton(max_steps=2), TIGHT
    assert abs(value(FRAME, early) / value(FRAME, late) - 1) > 1e-7
    gradients = [jax.jit(jax.grad(value), static_argnums=1)(FRAME, solver) for solver in (early, late)]
    np.testing.assert_allclose(*gradients, rtol=0, atol=1e-7 * float(abs(gradients[1]).max()))


def test_how_a_traced_reconstruction_ended():
    def found(frame, steps):
        solver = GaussNewton(max_steps=steps)
        return reconstruct(MODEL, frame, 1e-3, prior=Gaussian(0.04), hyperparameter=0.1, solver=solver)

    for steps, status in ((1, "step limit"), (30, "converged")):
        traced = eqx.filter_jit(lambda frame, steps=steps: found(frame, steps))(jnp.asarray(FRAME))
        assert traced.status == found(FRAME, steps).status == status
    broken = eqx.filter_jit(lambda frame: found(frame, 30))(jnp.asarray(FRAME) * jnp.nan)
    assert broken.status == "failed"
    assert not broken.converged
    with pytest.raises(ValueError, match="known outside only"):
        jax.jit(lambda frame: found(frame, 1).status == "converged")(FRAME)


def test_a_whole_model_may_be_differentiated_or_traced():
    """Protocol and cells included: reciprocal channels are then not combined, and the image is the same."""

    def image(model):
        found = reconstruct(model, FRAME, 1e-3, hyperparameter=10.0, noise=0.01 * np.abs(EMPTY), solver=TIGHT)
        return 1e3 * WEIGHT @ found.conductivity

    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(image))(MODEL)
    np.testing.assert_allclose(value, image(MODEL), rtol=1e-7)
    assert np.isfinite(gradient.protocol.drive).all()
    assert np.isfinite(gradient.electrodes.contact_impedance).all()
