"""`reconstruct`: the conductivity that explains a frame of voltages, by nonlinear least squares."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jeit.forward import ForwardModel
from jeit.inverse.bases import DiagonalBasis, Regions
from jeit.inverse.bounded import BOUNDED_METHODS, QuadraticForm, minimise_between
from jeit.inverse.channels import IndependentChannels
from jeit.inverse.choice import Choice
from jeit.inverse.hyperparameter import Rule, choose
from jeit.inverse.inversion import Inversion, Ridge
from jeit.inverse.links import AbstractLink, Bounded, Log
from jeit.inverse.noise import relative_noise
from jeit.inverse.priors import AbstractPrior, Noser
from jeit.inverse.spectrum import Spectrum
from jeit.inverse.total_variation import TotalVariation
from jeit.inverse.unknowns import AbstractUnknown
from jeit.mesh import Mesh
from jeit_solvers import Descent

METHODS = ("gauss-newton", "levenberg-marquardt", *BOUNDED_METHODS)
# Share of the background below which no conductivity is taken where nothing else keeps it from zero.
_LEAST = 1e-6
EDGE_PRICE = 300.0
"""λ of total variation unless given: what an edge as long as the body is wide costs, per unit of log σ."""


class Reconstruction(eqx.Module):
    """What `reconstruct` found, whichever solver ran.

    **Fields**: `conductivity` (m,), S/m (2-D: S); `voltages` (M,), what the model predicts for it; `misfit`, root mean
    square of predicted - measured over the channels used, in standard deviations (1: as good as the noise lets it be);
    `costs`, the objective at every accepted iterate, the start first (only at start and end where a solver keeps no
    record); `iterations`; `status`, "converged" or what happened instead, and `reason`, in a sentence;
    `choice` of the hyperparameter λ; `inversion` and `coefficients`, the problem solved and its
    solution, for warm starts and uncertainty; `model`, with the unknowns estimated along with the image put in.
    """

    conductivity: Float[Array, " m"]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    costs: Float[Array, " steps"]
    coefficients: Float[Array, " n"]
    inversion: Inversion
    model: ForwardModel
    choice: Choice
    iterations: int = eqx.field(static=True)
    status: str = eqx.field(static=True)
    reason: str = eqx.field(static=True)

    @property
    def hyperparameter(self) -> Float[Array, ""]:
        """λ."""
        return self.choice.hyperparameter

    @property
    def rule(self) -> str:
        """How λ was chosen."""
        return self.choice.rule

    @property
    def unknowns(self) -> dict[str, Float[Array, " k"]]:
        """What was estimated along with the conductivity, by the name of its class, in its own unit."""
        values = self.inversion.values(self.coefficients)
        return {type(one).__name__: value for one, value in zip(self.inversion.unknowns, values, strict=True)}


def reconstruct(
    model: ForwardModel,
    voltages: Float[Array, " M"],
    background,
    *,
    prior: AbstractPrior | TotalVariation | None = None,
    link: AbstractLink | None = None,
    hyperparameter: float | str | Rule | None = None,
    noise: Float[Array, " M"] | float | None = None,
    mask: Bool[Array, " M"] | None = None,
    solver: str | optx.AbstractLeastSquaresSolver = "gauss-newton",
    bounds: tuple[float, float] | None = None,
    regions=None,
    unknowns: Sequence[AbstractUnknown] = (),
    start: Reconstruction | None = None,
    max_steps: int | None = None,
    rtol: float | None = None,
) -> Reconstruction:
    """Conductivity per cell that explains measured `voltages` (M,), in volts: an absolute image.

    - `background`: what the prior expects, one number or (m,), S/m (2-D: S), see `calibrate`; and where to start.
    - `prior`: `Noser()` unless given; `TotalVariation()` for images of few pieces.
    - `link`: the scale on which the prior acts, `Log()` unless given.
    - `hyperparameter`: λ, the prior's weight, or a rule in `jeit.inverse.RULES`, used on the problem linearised at the
      background; "noise-figure" unless given. Total variation takes a number, 300 unless given.
    - `noise`: standard deviation of the channels in volts, one number or (M,); 1 % of their size unless given.
    - `mask`: True for the channels to use.
    - `solver`: a name in `METHODS`, or any least-squares solver of optimistix (not with total variation).
    - `bounds`: least and greatest conductivity, S/m (2-D: S); for the solvers "l-bfgs-b" (taken if bounds are given
      and no solver) and "projected-gradient", with priors that have a precision matrix, or total variation.
    - `regions` (m,): integers, cells that share one value; -1 for cells held at the background. See `pixels`.
    - `unknowns`: what else to estimate, see `jeit.inverse.unknowns`.
    - `start`: an earlier reconstruction of the same kind, to start from.
    - `max_steps`: 30 unless given (bounded solvers: 1000). `rtol`: relative change of the objective that ends the
      iteration, 1e-6 unless given (total variation: 1e-4); for bounded solvers the tolerance of a scaled step, 1e-6.

    Raises `ValueError` for arguments that do not fit; a solver that fails says so in the result's `status`.

    Tarantola, Inverse Problem Theory (SIAM 2005), ch. 3; Nocedal and Wright, Numerical Optimization (2006), ch. 10.
    """
    measured, used = check_frame(model, voltages, mask)
    link = Log() if link is None else link
    prior = Noser() if prior is None else prior
    if not isinstance(prior, (AbstractPrior, TotalVariation)) or not isinstance(link, AbstractLink):
        raise ValueError(f"prior and link must be of those in jeit.inverse, such as Noser() and Log(), not {prior!r}.")
    background = check_background(model, background)
    deviation = check_noise(noise, measured, used)
    if bounds is not None and solver == "gauss-newton":
        solver = "l-bfgs-b"
    kept = np.flatnonzero(used)
    observed = model.with_protocol(model.protocol.subset(kept))
    channels = IndependentChannels.create(observed.protocol)
    inversion, choice = pose(
        observed.with_protocol(observed.protocol.subset(np.asarray(channels.index))),
        channels.weigh(deviation[kept]).combine(measured[kept]),
        link,
        background,
        prior,
        hyperparameter,
        regions=regions,
        unknowns=tuple(unknowns),
        bounded=solver in BOUNDED_METHODS,
    )
    coefficients = jnp.zeros(inversion.num_coefficients)
    if start is not None:
        if start.coefficients.shape != coefficients.shape:
            raise ValueError(
                f"start has {start.coefficients.size} coefficients and this problem {coefficients.size}; give a "
                "reconstruction of the same model and prior."
            )
        size = inversion.basis.num_coefficients
        scale = choice.hyperparameter / start.choice.hyperparameter if isinstance(inversion.penalty, Ridge) else 1.0
        coefficients = start.coefficients.at[:size].multiply(scale)
    if isinstance(solver, str) and solver in BOUNDED_METHODS:
        box = _box(bounds, inversion, link)
        limit = 1000 if max_steps is None else max_steps
        found = _solve_between(inversion, coefficients, box, solver, limit, 1e-6 if rtol is None else rtol)
    else:
        if bounds is not None:
            raise ValueError(
                f"bounds: '{solver}' knows none; use {' or '.join(BOUNDED_METHODS)}, or link=Bounded(lower, upper)."
            )
        limit = 30 if max_steps is None else max_steps
        tolerance = (1e-4 if isinstance(prior, TotalVariation) else 1e-6) if rtol is None else rtol
        found = _solve(inversion, coefficients, _solver(solver, prior, limit, tolerance), limit)
    coefficients, iterations, costs, status, reason = found
    conductivity, fitted, predicted = _outcome(inversion, model, coefficients)
    excess = ((predicted - measured) / deviation)[kept]
    if not np.isfinite(np.asarray(conductivity)).all():
        status, reason = "failed", "The conductivity became NaN; give better data, more noise or a greater λ."
    return Reconstruction(
        conductivity=conductivity,
        voltages=predicted,
        misfit=jnp.sqrt(jnp.mean(excess**2)),
        costs=costs + inversion.data.rest / 2,
        coefficients=coefficients,
        inversion=inversion,
        model=fitted,
        choice=choice,
        iterations=iterations,
        status=status,
        reason=reason,
    )


def pose(model, data, link, background, prior, hyperparameter, *, regions=None, unknowns=(), bounded=False):
    """The problem for a `model` of independent channels and their `data`, and the choice of its λ."""
    mesh, reference = model.mesh, link.estimate(background)
    pooled = None if regions is None else Regions.create(mesh, regions)
    if isinstance(prior, TotalVariation):
        if pooled is not None:
            raise ValueError("regions: total variation finds its own; leave them out, or take another prior.")
        if isinstance(hyperparameter, str):
            raise ValueError(f"hyperparameter: total variation takes a number, not the rule '{hyperparameter}'.")
        value = EDGE_PRICE if hyperparameter is None else hyperparameter
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"hyperparameter must be positive and finite; it is {value}.")
        choice = Choice.given(value)
        penalty = prior.penalty(mesh, reference, choice.hyperparameter)
        return Inversion(model, data, link, reference, _every_cell(mesh), penalty, unknowns), choice

    predicted, jacobian = model.voltages_and_jacobian(background)
    seen = data.whiten(data.weight[:, None] * jacobian * link.slope(reference))
    spectrum = Spectrum.create(seen, prior.covariance_product(mesh, seen), prior.null_space(mesh))
    difference = data.whiten(data.weight * (data.voltages - predicted))
    choice = choose(spectrum, "noise-figure" if hyperparameter is None else hyperparameter, difference, mesh)
    if bounded:
        if pooled is not None:
            raise ValueError("regions: bounded solvers take every cell; use link=Bounded(lower, upper) instead.")
        penalty = QuadraticForm.create(prior.precision(mesh, seen), choice.hyperparameter)
        return Inversion(model, data, link, reference, _every_cell(mesh), penalty, unknowns), choice
    basis = prior.basis(mesh, seen).scaled(1 / choice.hyperparameter)
    basis = basis if pooled is None else basis.pooled(pooled)
    return Inversion(model, data, link, reference, basis, Ridge(), unknowns), choice


def _every_cell(mesh: Mesh) -> DiagonalBasis:
    return DiagonalBasis(jnp.ones(mesh.num_cells))


def check_frame(model: ForwardModel, voltages, mask) -> tuple[Float[Array, " M"], np.ndarray]:
    """Voltages as an array with zeros for what is left out, and which channels are used; raises `ValueError`."""
    if jnp.iscomplexobj(voltages):
        raise ValueError("voltages are complex; reconstruct from their real part or magnitude.")
    shape = (model.protocol.num_measurements,)
    measured = jnp.asarray(voltages, float)
    used = np.ones(shape, bool) if mask is None else np.asarray(mask)
    if measured.shape != shape or used.shape != shape or used.dtype != bool:
        raise ValueError(
            f"voltages has shape {measured.shape} and mask {used.shape} of {used.dtype}; protocol "
            f"'{model.protocol.name}' has {shape[0]} channels, and the mask must be booleans."
        )
    if not used.any():
        raise ValueError("mask: every channel is left out, so there is nothing to reconstruct from.")
    values = np.asarray(measured)[used]
    if not np.isfinite(values).all():
        raise ValueError(f"voltages: {(~np.isfinite(values)).sum()} channels in use are NaN or infinite; mask them.")
    if not values.any():
        raise ValueError("voltages: all channels in use read zero; was the current source on?")
    return jnp.where(used, measured, 0), used


def check_background(model: ForwardModel, background) -> Float[Array, " m"]:
    """The background per cell; raises `ValueError` for what is not one real number or one for each cell."""
    if jnp.iscomplexobj(background) or jnp.shape(background) not in ((), (model.mesh.num_cells,)):
        raise ValueError(
            f"background must be one real conductivity, or one for each of the {model.mesh.num_cells} cells; it is "
            f"{jnp.asarray(background).dtype} of shape {jnp.shape(background)}."
        )
    return jnp.broadcast_to(jnp.asarray(background, float), (model.mesh.num_cells,))


def check_noise(noise, measured: Float[Array, " M"], used: np.ndarray) -> Float[Array, " M"]:
    """Standard deviation of every channel, volts (1 where left out); raises `ValueError`."""
    if noise is not None and jnp.shape(noise) not in ((), measured.shape):
        raise ValueError(f"noise has shape {jnp.shape(noise)}; give one number, or one for each channel.")
    deviation = relative_noise(measured, used) if noise is None else np.broadcast_to(np.asarray(noise), measured.shape)
    if not (np.isfinite(deviation)[used] & (np.asarray(deviation)[used] > 0)).all():
        raise ValueError("noise must be positive and finite for every channel in use.")
    return jnp.where(used, deviation, 1)


def _solver(solver, prior, max_steps: int, rtol: float) -> optx.AbstractLeastSquaresSolver:
    if isinstance(solver, optx.AbstractLeastSquaresSolver):
        if isinstance(prior, TotalVariation):
            raise ValueError(
                "solver: total variation is not a sum of squares; use gauss-newton or levenberg-marquardt."
            )
        return solver
    if solver == "gauss-newton":
        return Descent(history=max_steps, rtol=rtol)
    if solver == "levenberg-marquardt":
        return Descent(history=max_steps, rtol=rtol, damping=1.0)
    raise ValueError(f"solver: there is no '{solver}'; give one of {', '.join(METHODS)}, or a solver of optimistix.")


def _residual(coefficients, inversion: Inversion):
    return inversion.data.whiten(inversion.residual(coefficients)), coefficients


def _expand(coefficients, inversion: Inversion):
    return inversion.quadratic_model(coefficients)


@eqx.filter_jit
def _minimise(inversion: Inversion, start, solver, max_steps: int):
    options = {"expand": _expand} if isinstance(solver, Descent) else {}
    return optx.least_squares(_residual, solver, start, inversion, options=options, max_steps=max_steps, throw=False)


def _solve(inversion: Inversion, start, solver, max_steps: int) -> tuple[Any, int, Any, str, str]:
    solution = _minimise(inversion, start, solver, max_steps)
    if isinstance(solver, Descent):
        accepted = int(solution.state.num_accepted)
        iterations, costs = max(accepted - 1, 0), solution.state.history[:accepted]
    else:
        iterations = int(solution.stats["num_steps"])
        costs = jnp.stack([_cost(inversion, start), _cost(inversion, solution.value)])
    return solution.value, iterations, costs, *_status(solution.result, max_steps)


def _solve_between(inversion: Inversion, start, box, method: str, max_steps: int, tolerance: float):
    start = jnp.clip(start, *box)
    lower, upper = box
    coefficients, steps, converged = minimise_between(inversion, start, lower, upper, method, max_steps, tolerance)
    costs = jnp.stack([_cost(inversion, start), _cost(inversion, coefficients)])
    if converged:
        return coefficients, int(steps), costs, "converged", "No step between the bounds would change the image much."
    return coefficients, int(steps), costs, *_status(optx.RESULTS.nonlinear_max_steps_reached, int(steps))


def _box(bounds, inversion: Inversion, link: AbstractLink):
    """Bounds on the coefficients, (n,) each, from bounds on conductivity; unknowns have none."""
    rest = inversion.num_coefficients - inversion.basis.num_coefficients
    lower, upper = (0.0, np.inf) if bounds is None else bounds
    if not 0 <= lower < upper:
        raise ValueError(f"bounds: give 0 ≤ lower < upper, S/m (2-D: S); they are {bounds}.")
    if isinstance(link, Bounded):
        raise ValueError("bounds: the link is bounded already; give bounds or link=Bounded(lower, upper), not both.")
    with np.errstate(divide="ignore"):
        ends = (
            [np.log(lower), np.log(upper)]
            if isinstance(link, Log)
            else [max(lower, _LEAST * float(inversion.reference.mean())), upper]
        )
    reference = inversion.reference
    if not ((reference >= ends[0]) & (reference <= ends[1])).all():
        raise ValueError(f"background must lie between the bounds, {lower:g} and {upper:g}.")
    free = jnp.full(rest, jnp.inf)
    return jnp.concatenate([ends[0] - reference, -free]), jnp.concatenate([ends[1] - reference, free])


@eqx.filter_jit
def _cost(inversion: Inversion, coefficients):
    return inversion.cost(coefficients)


@eqx.filter_jit
def _outcome(inversion: Inversion, model: ForwardModel, coefficients):
    """Conductivity, the model as fitted, and what it predicts for all channels, masked or not."""
    fitted = inversion.applied(model, coefficients)
    conductivity = inversion.conductivity(coefficients)
    return conductivity, fitted, fitted.voltages(conductivity)


def _status(result, max_steps: int) -> tuple[str, str]:
    if result == optx.RESULTS.successful:
        return "converged", "The next step would change the objective by less than the tolerance."
    if result == optx.RESULTS.nonlinear_max_steps_reached:
        return "not converged", f"Stopped after {max_steps} steps; raise max_steps, or the hyperparameter."
    return "stalled", "No shorter step lowered the objective; the model is at odds with the data."
