"""Gradients of every kind of image with respect to all its inputs, including electrodes and nodes, against finite
differences on a sufficiently fine mesh; batches against loops, and compiled against uncompiled results."""

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

pytestmark = pytest.mark.slow  # no electrode ends on a node, where derivatives jump

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
# Sizes for the steps of differences: channels, cells, noise relative to themselves, electrodes and points in metres.
SIZE = {"data": 0.01 * EMPTY, "background": 1e-3, "noise": THETA["noise"], "position": 1e-2, "points": 1e-3}


def placed(theta, model=MODEL):
    """The model with the electrodes and points given in `theta`."""
    moved = model.with_electrodes(eqx.tree_at(lambda e: e.position, model.electrodes, theta["position"]))
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


def solved(theta, prior, solver, parametrisation=None, model=MODEL):
    """The reconstruction with every input in `theta`."""
    return reconstruct(
        placed(THETA | theta, model),
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


TIGHT = GaussNewton(max_steps=100, rtol=1e-24)


def test_nonlinear_images_of_a_traced_model():
    """Protocol and cells are traced too. Reciprocal channels are then not combined, and the image is the same."""

    def image(theta, model=MODEL):
        model = model.with_electrodes(model.electrodes.with_contact_impedance(theta["contact"]))
        return image_of(solved(theta, Noser(), TIGHT, model=model))

    theta = THETA | {"hyperparameter": np.array(10.0), "contact": np.full(8, 1e-2)}
    program = eqx.filter_jit(eqx.filter_value_and_grad(lambda both: image(*both)))
    value, (gradient, of_model) = program((theta, MODEL))
    np.testing.assert_allclose(value, image(theta), rtol=1e-8)
    image_slopes.assert_slopes(image, theta, gradient, SIZE)
    assert np.isfinite(of_model.protocol.drive).all()


def test_uncertainties():
    def deviation(theta):
        around = posterior(solved(theta, Noser(), TIGHT))
        return 1e3 * WEIGHT @ around.standard_deviation() + 1e3 * around.region(np.flatnonzero(INSIDE))[1]

    assert_gradient(deviation, THETA | {"hyperparameter": 10.0})


@pytest.mark.parametrize("prior", [Gaussian(0.02), Laplace()], ids=lambda p: type(p).__name__)
def test_nonlinear_images_of_smooth_priors(prior):
    """At some lengths the basis of the Gaussian gains a shape and the image jumps; the tested one is far from these."""
    settings = {"hyperparameter": 3.0} | ({"length": 0.02} if isinstance(prior, Gaussian) else {})

    def image(theta):
        chosen = Gaussian(theta["length"]) if isinstance(prior, Gaussian) else prior
        return image_of(solved(theta, chosen, LevenbergMarquardt(max_steps=100, rtol=1e-24)))

    assert_gradient(image, THETA | settings)


def test_images_of_total_variation():
    """By the optimality condition of the smoothed energy, not by its quadratic models. The background has almost no
    effect."""
    assert_gradient(
        lambda theta: image_of(solved(theta, TotalVariation(0.3), GaussNewton(max_steps=1000, rtol=1e-16))),
        {name: value for name, value in THETA.items() if name != "background"} | {"hyperparameter": 3.0},
    )


def test_images_between_bounds():
    """Cells at a bound stay there, and move with it."""

    def image(theta, solver):
        within = Parametrisation(bounds=(0.9e-3, theta["upper"]))
        found = solved(theta, Noser(), solver, within)
        return found, 1e3 * WEIGHT @ found.conductivity

    theta, solver = THETA | {"hyperparameter": 3.0, "upper": 1.25e-3}, LBFGSB(max_steps=5000, tolerance=1e-13)
    conductivity = np.asarray(image(theta, solver)[0].conductivity)
    at_bound = np.isclose(conductivity, 1.25e-3, rtol=1e-9) | np.isclose(conductivity, 0.9e-3, rtol=1e-9)
    assert 3 <= at_bound.sum() <= len(conductivity) - 3
    image_slopes.assert_gradient_of_minimum(image, theta, SIZE, solver, between=True)


def test_images_with_further_unknowns():
    """With respect to all inputs except the nodes, which reach unknowns only by the model, as in the tests above."""
    unknowns = [ContactImpedance(MODEL, 0.1), ElectrodePosition(MODEL, 3e-4), Scale(0.03)]

    def image(theta):
        found = solved(theta, Noser(), TIGHT, Parametrisation(unknowns=unknowns))
        return image_of(found) + 1e3 * jnp.sum(found.model.electrodes.contact_impedance)

    theta = {name: value for name, value in THETA.items() if name != "points"} | {"hyperparameter": 10.0}
    # There is no uncompiled result here.
    assert_gradient(image, theta, equal=None, compiled=True)


@pytest.mark.parametrize(("contact", "names"), [("common", ["data"]), ("each", ["position", "points", "data"])])
def test_calibrations(contact, names):
    """One impedance for all electrodes, fitted to the data alone; electrodes and nodes enter in the same way."""
    apart = ELECTRODES.with_contact_impedance(np.linspace(0.2, 0.5, 8))
    wide = MODEL.with_electrodes(ELECTRODES.with_contact_impedance(np.full(8, 0.3)))
    data = MODEL.with_electrodes(apart).voltages(2e-3) * (1 + 1e-3 * np.random.default_rng(2).normal(size=EMPTY.shape))

    def fitted(theta):
        theta = THETA | theta
        moved = wide.with_electrodes(eqx.tree_at(lambda e: e.position, wide.electrodes, theta["position"]))
        model = eqx.tree_at(lambda m: m.mesh.points, moved, theta["points"])
        found = calibrate(model, theta["data"], contact=contact)
        impedance = found.model.electrodes.contact_impedance @ np.arange(1.0, 9.0)
        return 1e3 * found.conductivity + impedance + 1e2 * found.misfit + found.contact_deviation.sum()

    theta = {name: (THETA | {"data": data})[name] for name in names}
    assert_gradient(fitted, theta, equal=1e-6, compiled=True)  # uncompiled, it ends where parameters change by 1e-8


def test_gradients_of_batches_are_batches_of_gradients():
    frames = np.stack([FRAME, 1.1 * FRAME])

    def value(frame):
        found = reconstruct(MODEL, frame, 1e-3, prior=Gaussian(0.04), hyperparameter=3.0, noise=0.01 * np.abs(EMPTY))
        return 1e3 * WEIGHT @ found.conductivity

    map_one_by_one, gradients = zip(*map(jax.jit(jax.value_and_grad(value)), frames), strict=True)
    values, together = jax.vmap(jax.value_and_grad(value))(frames)
    np.testing.assert_allclose(values, map_one_by_one, rtol=1e-8)
    np.testing.assert_allclose(together, np.stack(gradients), rtol=1e-7)
