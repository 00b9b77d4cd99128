"""`reconstruct`: the conductivity that explains a frame of voltages, by nonlinear least squares."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jeit.forward import ForwardModel
from jeit.inverse.channels import IndependentChannels
from jeit.inverse.hyperparameter.choice import Choice
from jeit.inverse.hyperparameter.rules import Rule, choose
from jeit.inverse.nonlinear.bounded import BOUNDED_METHODS, QuadraticForm, minimise_between
from jeit.inverse.nonlinear.checks import (
    check_background,
    check_bounds,
    check_frame,
    check_link,
    check_noise,
    check_prior,
    check_steps,
    check_tolerance,
    check_unknowns,
)
from jeit.inverse.nonlinear.links import AbstractLink, Bounded, Log
from jeit.inverse.nonlinear.problem import Inversion, Ridge
from jeit.inverse.nonlinear.unknowns import AbstractUnknown
from jeit.inverse.prior.bases import DiagonalBasis, Regions
from jeit.inverse.prior.priors import AbstractPrior, Noser
from jeit.inverse.prior.total_variation import TotalVariation
from jeit.inverse.spectrum import Spectrum
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
    - `unknowns`: what else to estimate, see `jeit.inverse.nonlinear.unknowns`.
    - `start`: an earlier reconstruction of the same kind, to start from.
    - `max_steps`: 30 unless given (bounded solvers: 1000). `rtol`: relative change of the objective that ends the
      iteration, 1e-6 unless given (total variation: 1e-4); for bounded solvers the tolerance of a scaled step, 1e-6.

    Raises `ValueError` for arguments that do not fit; a solver that fails says so in the result's `status`.

    Tarantola, Inverse Problem Theory (SIAM 2005), ch. 3; Nocedal and Wright, Numerical Optimization (2006), ch. 10.
    """
    measured, used = check_frame(model, voltages, mask)
    link = Log() if link is None else link
    prior = Noser() if prior is None else prior
    check_prior(prior)
    check_link(link)
    unknowns = check_unknowns(unknowns, model)
    if rtol is None:
        rtol = 1e-4 if isinstance(prior, TotalVariation) and solver not in BOUNDED_METHODS else 1e-6
    tolerance = check_tolerance(rtol)
    limits = check_bounds(bounds)
    background = check_background(model, background)
    deviation = check_noise(noise, measured, used)
    if bounds is not None and solver == "gauss-newton":
        solver = "l-bfgs-b"
    bounded = solver if isinstance(solver, str) and solver in BOUNDED_METHODS else None
    if max_steps is None:
        max_steps = 30 if bounded is None else 1000
    max_steps = check_steps("max_steps", max_steps)
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
        unknowns=unknowns,
        bounded=bounded is not None,
    )
    coefficients = jnp.zeros(inversion.num_coefficients)
    if start is not None:
        if not isinstance(start, Reconstruction):
            raise ValueError(f"start must be what reconstruct has returned, not {type(start).__name__}.")
        if start.coefficients.shape != coefficients.shape or not _alike(start.inversion, inversion):
            raise ValueError(
                f"start has {start.coefficients.size} coefficients of another kind of problem; this one has "
                f"{coefficients.size}. Give a reconstruction of the same model, prior and link."
            )
        size = inversion.basis.num_coefficients
        scale = choice.hyperparameter / start.choice.hyperparameter if isinstance(inversion.penalty, Ridge) else 1.0
        coefficients = start.coefficients.at[:size].multiply(scale)
    if bounded is not None:
        box = _box(limits, inversion, link)
        found = _solve_between(inversion, coefficients, box, bounded, max_steps, tolerance)
    else:
        if bounds is not None:
            raise ValueError(
                f"bounds: '{solver}' knows none; use {' or '.join(BOUNDED_METHODS)}, or link=Bounded(lower, upper)."
            )
        found = _solve(inversion, coefficients, _solver(solver, prior, max_steps, tolerance), max_steps)
    coefficients, iterations, costs, status, reason = found
    conductivity, fitted, predicted = _outcome(inversion, model, coefficients)
    excess = ((predicted - measured) / deviation)[kept]
    if not (np.isfinite(conductivity).all() and np.isfinite(excess).all()):
        status, reason = "failed", "Conductivity or voltages are NaN; give better data, more noise or a greater λ."
    elif status != "converged":
        reason += _mismatch(model, measured[kept], background, kept)
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
        if isinstance(hyperparameter, str) or callable(hyperparameter):
            raise ValueError(f"hyperparameter: total variation takes a number, not the rule {hyperparameter!r}.")
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


def _alike(one: Inversion, other: Inversion) -> bool:
    """Whether the coefficients of two problems mean the same kind of thing."""

    def kinds(inversion):
        return [type(part) for part in (inversion.link, inversion.basis, inversion.penalty, *inversion.unknowns)]

    return kinds(one) == kinds(other)


def _mismatch(model: ForwardModel, measured, background, kept) -> str:
    """A hint where voltages and background are of different size or sign: units, or polarity."""
    expected = model.voltages(background)[kept]
    ratio = float(jnp.vdot(measured, expected) / jnp.vdot(expected, expected))
    if 0.1 < ratio < 10:
        return ""
    return f" The voltages are {ratio:.2g} times those of the background; are they in volts, and their signs right?"


def _box(limits, inversion: Inversion, link: AbstractLink):
    """Bounds on the coefficients, (n,) each, from `limits` on conductivity; unknowns have none."""
    rest = inversion.num_coefficients - inversion.basis.num_coefficients
    lower, upper = limits
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
        return "not converged", f"Stopped after {max_steps} trial steps; raise max_steps, or the hyperparameter."
    return "stalled", "No shorter step lowered the objective; the model is at odds with the data."
