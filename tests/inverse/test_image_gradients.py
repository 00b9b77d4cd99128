"""Differentiable images, calibrations and uncertainties: gradients with respect to all inputs against finite
differences, batches against loops, and compiled against uncompiled results."""

from typing import Any

import equinox as eqx
import image_slopes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import (
    Gaussian,
    Laplace,
    Noser,
    Parametrisation,
    Tikhonov,
    calibrate,
    one_step,
    reconstruct,
)
from jeit.inverse.nonlinear import LBFGSB, GaussNewton
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent

ANGLE = 2 * np.pi * np.arange(5) / 5 + 0.13  # no electrode ends on a node, where derivatives jump
ELECTRODES = BoundaryElectrodes(0.1 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1), 0.02, 1e-2)
MESH = Disk(0.1).mesh(num_points=16)
MODEL: Any = ForwardModel(MESH, ELECTRODES, adjacent(5, current=1e-3))
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
# Inputs that compile quickly, and those that take seconds: the geometry.
VARIED = {name: THETA[name] for name in ("data", "background", "noise")}
FIXED = {name: THETA[name] for name in ("position", "points")}
# Sizes for the steps of differences: channels, cells, noise relative to themselves, electrodes and points in metres.
SIZE = {"data": 0.01 * EMPTY, "background": 1e-3, "noise": THETA["noise"], "position": 1e-2, "points": 1e-3}


def placed(theta):
    """The model with the electrodes and points given in `theta`."""
    moved = MODEL.with_electrodes(eqx.tree_at(lambda e: e.position, MODEL.electrodes, theta["position"]))
    return eqx.tree_at(lambda m: m.mesh.points, moved, theta["points"])


def assert_gradient(function, theta, **settings):
    image_slopes.assert_gradient(function, theta, SIZE, **settings)


def linear_image(theta, prior):
    linear = one_step(
        placed(theta), theta["background"], prior=prior, hyperparameter=theta["hyperparameter"], noise=theta["noise"]
    )
    return 1e3 * WEIGHT @ linear.image(theta["data"] - EMPTY)


def test_linear_images():
    """Three priors in one function, to compile once; the fourth prior and the geometry are tested below."""

    def image(theta):
        theta = FIXED | theta
        priors = (Noser(), Laplace(), Gaussian(theta["length"]))
        return sum(
            linear_image(theta | {"hyperparameter": theta[f"level {number}"]}, prior)
            for number, prior in enumerate(priors)
        )

    assert_gradient(image, VARIED | {"level 0": 3.0, "level 1": 1e4, "level 2": 1e3, "length": 0.03})


def test_the_gaussian_prior_with_respect_to_points():
    rows = RANDOM.normal(size=(2, MESH.num_cells))

    def product(theta):
        mesh = eqx.tree_at(lambda m: m.points, MESH, theta["points"])
        return WEIGHT @ Gaussian(0.03).covariance_product(mesh, rows) @ np.array([1.0, 2.0])

    assert_gradient(product, {"points": THETA["points"]})


def solved(theta, prior, solver, parametrisation=None):
    """The reconstruction with every input in `theta`."""
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


@pytest.mark.slow
def test_nonlinear_images():
    """Against differences. Derivatives of coefficients are those of the minimum, even if the solver stopped early."""

    def image(theta, solver):
        theta = {name: theta.get(name, THETA.get(name)) for name in (*VARIED, "hyperparameter", "share")}
        found = reconstruct(
            MODEL,
            theta["data"],
            theta["background"],
            prior=Tikhonov(),
            hyperparameter=theta["hyperparameter"],
            noise=theta["noise"],
            solver=solver,
        )
        every = np.arange(found.coefficients.size)
        return found, found.coefficients @ every + theta["share"] * (1e3 * WEIGHT @ found.conductivity)

    one = VARIED | {"hyperparameter": np.array(1.0), "share": np.array(1.0)}
    narrow = one | {"share": np.array(0.0)}
    cases = [(one, TIGHT), (narrow, TIGHT), (narrow, GaussNewton(max_steps=2))]
    compiled = jax.jit(jax.value_and_grad(lambda theta, ended: image(theta, image_slopes.Known(ended))[1]))
    gradients, values = [], []
    for theta, solver in cases:
        found, expected = image(theta, solver)
        value, gradient = compiled(theta, found.coefficients)
        np.testing.assert_allclose(value, expected, rtol=1e-8)
        values.append(expected)
        gradients.append(jax.tree.map(np.asarray, gradient))
    image_slopes.assert_slopes(lambda theta: image(theta, TIGHT)[1], one, gradients[0], SIZE)
    assert abs(values[2] / values[1] - 1) > 1e-7
    for name in VARIED:
        late, early = gradients[1][name], gradients[2][name]
        np.testing.assert_allclose(early, late, rtol=0, atol=1e-7 * float(abs(late).max()))


@pytest.mark.parametrize("solver", [GaussNewton(), pytest.param(LBFGSB(), marks=pytest.mark.slow)])
def test_the_iteration_is_not_differentiated(solver):
    """Gradients of the solution can be traced with respect to all arrays of a model."""
    points: Any = ForwardModel(MESH, PointElectrodes(0.9 * THETA["position"]), MODEL.protocol)
    gradient = eqx.filter_eval_shape(eqx.filter_grad(lambda model: image_of(whole(model, solver))), points)
    assert gradient.mesh.points.shape == MODEL.mesh.points.shape
    assert gradient.protocol.drive.shape == MODEL.protocol.drive.shape


def test_batches_of_linear_images():
    frames = np.stack([FRAME, 0.9 * FRAME, 0.5 * (FRAME + EMPTY)])

    def linear(frame):
        xp = np if isinstance(frame, np.ndarray) else jnp
        return one_step(MODEL, 1e-3, hyperparameter=30.0, noise=0.01 * xp.abs(frame)).image(frame - EMPTY)

    map_one_by_one = np.stack([linear(frame) for frame in frames])
    batch = jax.jit(jax.vmap(linear))(frames)
    np.testing.assert_allclose(batch, map_one_by_one, rtol=0, atol=1e-9 * abs(map_one_by_one).max())


@pytest.mark.slow
def test_batches_of_reconstructions_and_their_status():
    """Compiled in a batch against one after the other: one that converged, one that did not, and one of NaN."""

    def found(frame):
        return reconstruct(
            MODEL, frame, 1e-3, prior=Gaussian(0.04), hyperparameter=0.1, solver=GaussNewton(max_steps=3)
        )

    frames = np.stack([1.001 * EMPTY, 0.3 * FRAME, np.full_like(FRAME, np.nan)])
    batch = eqx.filter_jit(eqx.filter_vmap(found))(frames)
    for index, status in enumerate(("converged", "step limit", "failed")):
        traced = jax.tree.map(lambda leaf, index=index: np.asarray(leaf)[index], batch)
        assert traced.status == status
        assert bool(traced.converged) == (status == "converged")
        if status != "failed":
            alone = found(frames[index])
            assert alone.status == status
            assert alone.iterations == traced.iterations
            np.testing.assert_allclose(traced.conductivity, alone.conductivity, rtol=1e-8)
            np.testing.assert_allclose(traced.misfit, alone.misfit, rtol=1e-8)
    with pytest.raises(ValueError, match="the status has no value yet"):
        jax.jit(lambda frame: found(frame).status == "converged")(FRAME)


REFUSED = {
    "rule": (lambda x: one_step(MODEL, x).weights, "hyperparameter: the problem is traced.*noise-figure"),
    "rule of reconstruct": (lambda x: reconstruct(MODEL, FRAME, x).misfit, "hyperparameter: the problem is traced"),
    "rule on data": (
        lambda x: one_step(MODEL, 1e-3, hyperparameter="gcv", difference=FRAME * x).weights,
        r"difference \(voltages\) is traced.*gcv",
    ),
    "mask": (
        lambda x: one_step(MODEL, 1e-3, hyperparameter=1.0, mask=x < FRAME).weights,
        "mask is traced.*array of NumPy",
    ),
    "mask of reconstruct": (
        lambda x: reconstruct(MODEL, FRAME, 1e-3, hyperparameter=1.0, mask=x < FRAME).misfit,
        "mask is traced",
    ),
    "mask of calibrate": (lambda x: calibrate(MODEL, FRAME, mask=x < FRAME).misfit, "mask is traced"),
    "cells": (
        lambda x: (
            one_step(
                eqx.tree_at(lambda m: m.mesh.cells, MODEL, MODEL.mesh.cells + 0 * x.astype(int)),
                1e-3,
                prior=Laplace(),
                hyperparameter=1.0,
            ).weights
        ),
        "mesh: its cells is traced|mesh: its cells are traced",
    ),
    "informative": (
        lambda x: (
            reconstruct(MODEL, FRAME, x, hyperparameter=1.0, parametrisation=Parametrisation(informative=0.1)).misfit
        ),
        "informative: the problem is traced",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_settings_that_must_be_known_outside_are_reported(name):
    function, match = REFUSED[name]
    with pytest.raises(ValueError, match=match):
        jax.jit(function)(1e-3)


def whole(model, solver):
    return reconstruct(model, FRAME, 1e-3, hyperparameter=10.0, noise=0.01 * np.abs(EMPTY), solver=solver)
