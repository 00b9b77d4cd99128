"""The fit of a calibration where anything of it is traced: the same parameters and objective, compiled, and its result
a function of the voltages and of the model that has derivatives."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from jeit.forward import ForwardModel
from jeit_solvers import Status, as_minimum, ended_number, symmetric_inverse
from jeit_solvers.engines import on_device, undifferentiated

# Logarithm of a contact impedance over the model's, beyond which it is all the same.
FARTHEST = 50.0
# Of the parameters and the misfit: as exact as double precision lets it be.
_TOLERANCE = 1e-12


class TracedFit(NamedTuple):
    """The model, conductivity, predicted voltages, misfit, standard deviations of the contacts, iterations and the
    `Status.number` of a fit."""

    model: ForwardModel
    conductivity: Float[Array, ""]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    contact_deviation: Float[Array, " k"]
    iterations: Int[Array, ""]
    outcome: Int[Array, ""]


@eqx.filter_jit
def traced_fit(model: ForwardModel, measured: Float[Array, " M"], used, contact: str, max_steps: int) -> TracedFit:
    """Logarithms of σ and of z·σ over the model's z for the least misfit of the channels `used`; see `calibrate`."""
    problem = on_device((model, measured, used))
    unit = jnp.where(used, model.voltages(1.0), 0)
    size = {"fixed": 1, "common": 2, "each": 1 + model.electrodes.num_electrodes}[contact]
    start = jnp.full(size, jnp.log(unit @ unit / (unit @ jnp.where(used, measured, 0))))
    solver = optx.LevenbergMarquardt(rtol=_TOLERANCE, atol=_TOLERANCE)
    residual = partial(_residual, contact)
    frozen_start, frozen = undifferentiated((start, problem))
    found = optx.least_squares(residual, solver, frozen_start, frozen, max_steps=max_steps, throw=False)
    parameters = as_minimum(found.value, problem, partial(_gradient, contact), partial(_inverse, contact))
    fitted, conductivity = _applied(contact, parameters, model)
    left = residual(parameters, problem)
    covariance = symmetric_inverse(_normal(contact, parameters, problem))
    freedom = jnp.maximum(jnp.sum(used) - size, 1)
    deviation = jnp.sqrt(covariance.diagonal() * (left @ left) / freedom)[1:]
    misfit = jnp.sqrt(left @ left)
    outcome = jnp.where(jnp.isfinite(misfit), ended_number(found.result), Status.FAILED.number)
    steps = found.stats["num_steps"]
    return TracedFit(fitted, conductivity, fitted.voltages(conductivity), misfit, deviation, steps, outcome)


def _applied(contact: str, parameters, model: ForwardModel) -> tuple[ForwardModel, Any]:
    """The model and conductivity that the parameters stand for."""
    conductivity = jnp.exp(parameters[0])
    if contact == "fixed":
        return model, conductivity
    factor = jnp.exp(jnp.clip(parameters[1:] - parameters[0], -FARTHEST, FARTHEST))
    impedance = model.electrodes.contact_impedance * factor
    return model.with_electrodes(model.electrodes.with_contact_impedance(impedance)), conductivity


def _residual(contact: str, parameters, problem):
    model, measured, used = problem
    fitted, conductivity = _applied(contact, parameters, model)
    predicted = fitted.voltages(conductivity)
    return jnp.where(used, predicted - measured, 0) / jnp.linalg.norm(jnp.where(used, measured, 0))


def _gradient(contact: str, parameters, problem):
    return jax.grad(lambda p: 0.5 * jnp.sum(_residual(contact, p, problem) ** 2))(parameters)


def _normal(contact: str, parameters, problem):
    """JᵀJ (p, p)."""
    jacobian = jax.jacfwd(lambda p: _residual(contact, p, problem))(parameters)
    return jacobian.T @ jacobian


def _inverse(contact: str, parameters, problem):
    """Of Gauss-Newton's matrix."""
    inverse = symmetric_inverse(_normal(contact, parameters, problem))
    return lambda vector: inverse @ vector
