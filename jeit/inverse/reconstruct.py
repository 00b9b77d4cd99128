"""`reconstruct`: the conductivity that explains a frame of voltages, by nonlinear least squares."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jeit.forward import ForwardModel
from jeit.inverse.bases import AbstractBasis
from jeit.inverse.hyperparameter import Spectrum, choose
from jeit.inverse.links import AbstractLink, Log
from jeit.inverse.noise import relative_noise
from jeit.inverse.priors import AbstractPrior, Noser
from jeit_solvers import RidgeSolver

METHODS = ("gauss-newton", "levenberg-marquardt")


class Inversion(eqx.Module):
    """A nonlinear inverse problem, whitened: the c that minimises ½‖w (v(σ) - y)‖² + ½‖c‖², σ = link(x₀ + S c).

    **Fields**: `model`; `link`; `reference` x₀ (m,), on the link's scale; `basis` S, with the hyperparameter in it;
    `voltages` y (M,); `weight` w (M,), 1 / standard deviation of the channels, 0 for those left out.
    """

    model: ForwardModel
    link: AbstractLink
    reference: Float[Array, " m"]
    basis: AbstractBasis
    voltages: Float[Array, " M"]
    weight: Float[Array, " M"]

    def conductivity(self, coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
        """σ per cell, S/m (2-D: S)."""
        return self.link.conductivity(self.reference + self.basis.expand(coefficients))

    def misfit(self, coefficients: Float[Array, " n"]) -> Float[Array, " M"]:
        """w (v(σ) - y), in standard deviations."""
        return self.weight * (self.model.voltages(self.conductivity(coefficients)) - self.voltages)

    def linearise(self, coefficients: Float[Array, " n"]) -> tuple[Float[Array, " M"], Float[Array, "M n"]]:
        """`misfit`, and its Jacobian with respect to the coefficients."""
        estimate = self.reference + self.basis.expand(coefficients)
        voltages, jacobian = self.model.voltages_and_jacobian(self.link.conductivity(estimate))
        rows = self.weight[:, None] * jacobian * self.link.slope(estimate)
        return self.weight * (voltages - self.voltages), self.basis.restrict(rows)


class Reconstruction(eqx.Module):
    """What `reconstruct` found, whichever solver ran.

    **Fields**: `conductivity` (m,), S/m (2-D: S); `voltages` (M,), what the model predicts for it; `misfit`, root mean
    square of predicted - measured over the channels used, in standard deviations (1: as good as the noise lets it be);
    `costs`, the objective at every accepted iterate, the start first (with a solver of optimistix's own, at the end
    only); `iterations`; `status`, "converged" or what
    happened instead, and `reason`, in a sentence; `hyperparameter` λ and `rule`, how it was chosen; `inversion` and
    `coefficients`, the problem solved and its solution, for warm starts and uncertainty.
    """

    conductivity: Float[Array, " m"]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    costs: Float[Array, " steps"]
    coefficients: Float[Array, " n"]
    inversion: Inversion
    hyperparameter: Float[Array, ""]
    iterations: int = eqx.field(static=True)
    status: str = eqx.field(static=True)
    reason: str = eqx.field(static=True)
    rule: str = eqx.field(static=True)


def reconstruct(
    model: ForwardModel,
    voltages: Float[Array, " M"],
    background,
    *,
    prior: AbstractPrior | None = None,
    link: AbstractLink | None = None,
    hyperparameter: float | str = "noise-figure",
    noise: Float[Array, " M"] | float | None = None,
    mask: Bool[Array, " M"] | None = None,
    solver: str | optx.AbstractLeastSquaresSolver = "gauss-newton",
    start: Reconstruction | None = None,
    max_steps: int = 30,
) -> Reconstruction:
    """Conductivity per cell that explains measured `voltages` (M,), in volts: an absolute image.

    `background`: what the prior expects, one number or (m,), S/m (2-D: S), see `calibrate`; and the start, unless
    `start` is given: an earlier reconstruction of the same model and prior. `prior`: `Noser()` unless given. `link`:
    scale on which the prior acts, `Log()` unless given. `noise`: standard deviation of the channels in volts, one
    number or (M,); 1 % of their size unless given (`relative_noise`). `hyperparameter`: λ, the prior's weight, or a
    rule in `jeit.inverse.RULES`, used on the problem linearised at the background. `mask`: True for the channels to
    use. `solver`: a name in `METHODS`, or any least-squares solver of optimistix. Raises `ValueError` for arguments
    that do not fit; a solver that fails says so in the result's `status`.

    Tarantola, Inverse Problem Theory (SIAM 2005), ch. 3; Nocedal and Wright, Numerical Optimization (2006), ch. 10.
    """
    measured, used = _check_frame(model, voltages, mask)
    link = Log() if link is None else link
    prior = Noser() if prior is None else prior
    if not isinstance(prior, AbstractPrior) or not isinstance(link, AbstractLink):
        raise ValueError(f"prior and link must be of those in jeit.inverse, such as Noser() and Log(), not {prior!r}.")
    if jnp.iscomplexobj(background) or jnp.shape(background) not in ((), (model.mesh.num_cells,)):
        raise ValueError(
            f"background must be one real conductivity, or one for each of the {model.mesh.num_cells} cells; it is "
            f"{jnp.asarray(background).dtype} of shape {jnp.shape(background)}."
        )
    background = jnp.broadcast_to(jnp.asarray(background, float), (model.mesh.num_cells,))
    reference = link.estimate(background)
    if noise is not None and jnp.shape(noise) not in ((), measured.shape):
        raise ValueError(f"noise has shape {jnp.shape(noise)}; give one number, or one for each channel.")
    deviation = relative_noise(measured, used) if noise is None else np.broadcast_to(np.asarray(noise), measured.shape)
    if not (np.isfinite(deviation)[used] & (np.asarray(deviation)[used] > 0)).all():
        raise ValueError("noise must be positive and finite for every channel in use.")
    weight = jnp.where(used, 1 / jnp.where(used, deviation, 1), 0)

    predicted, jacobian = model.voltages_and_jacobian(background)
    whitened = weight[:, None] * jacobian * link.slope(reference)
    basis = prior.basis(model.mesh, whitened)
    channels = np.flatnonzero(used)
    seen = whitened[channels]
    spectrum = Spectrum.create(seen, prior.covariance_product(model.mesh, seen), prior.null_space(model.mesh))
    chosen, rule = choose(spectrum, hyperparameter, (weight * (measured - predicted))[channels])

    inversion = Inversion(model, link, reference, basis.scaled(1 / chosen), measured, weight)
    coefficients = jnp.zeros(basis.num_coefficients)
    if start is not None:
        if start.coefficients.shape != coefficients.shape:
            raise ValueError(
                f"start has {start.coefficients.size} coefficients and this problem {coefficients.size}; give a "
                "reconstruction of the same model and prior."
            )
        coefficients = start.coefficients * (chosen / start.hyperparameter)
    return _solve(inversion, coefficients, _solver(solver, max_steps), max_steps, chosen, rule)


def _check_frame(model: ForwardModel, voltages, mask) -> tuple[Float[Array, " M"], np.ndarray]:
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


def _solver(solver, max_steps: int) -> optx.AbstractLeastSquaresSolver:
    if isinstance(solver, optx.AbstractLeastSquaresSolver):
        return solver
    if solver == "gauss-newton":
        return RidgeSolver(history=max_steps)
    if solver == "levenberg-marquardt":
        return RidgeSolver(history=max_steps, damping=1.0)
    raise ValueError(f"solver: there is no '{solver}'; give one of {', '.join(METHODS)}, or a solver of optimistix.")


def _residual(coefficients, inversion: Inversion):
    return inversion.misfit(coefficients), coefficients


def _linearise(coefficients, inversion: Inversion):
    return inversion.linearise(coefficients)


@eqx.filter_jit
def _minimise(inversion: Inversion, start, solver, max_steps: int):
    options = {"linearise": _linearise} if isinstance(solver, RidgeSolver) else {}
    solution = optx.least_squares(
        _residual, solver, start, inversion, options=options, max_steps=max_steps, throw=False
    )
    conductivity = inversion.conductivity(solution.value)
    voltages = inversion.model.voltages(conductivity)
    return solution, conductivity, voltages


def _solve(inversion: Inversion, start, solver, max_steps: int, hyperparameter, rule: str) -> Reconstruction:
    solution, conductivity, voltages = _minimise(inversion, start, solver, max_steps)
    coefficients = solution.value
    misfit = inversion.weight * (voltages - inversion.voltages)
    used = np.asarray(inversion.weight) > 0
    if isinstance(solver, RidgeSolver):
        steps = int(solution.state.num_accepted)
        costs = solution.state.history[:steps]
    else:
        steps = int(solution.stats["num_steps"])
        costs = 0.5 * jnp.array([misfit @ misfit + coefficients @ coefficients])
    status, reason = _status(solution.result, max_steps)
    if not np.isfinite(np.asarray(conductivity)).all():
        status, reason = "failed", "The conductivity became NaN; give better data, more noise or a greater λ."
    return Reconstruction(
        conductivity=conductivity,
        voltages=voltages,
        misfit=jnp.sqrt(jnp.sum(misfit**2) / used.sum()),
        costs=costs,
        coefficients=coefficients,
        inversion=inversion,
        hyperparameter=jnp.asarray(hyperparameter),
        iterations=max(steps - 1, 0) if isinstance(solver, RidgeSolver) else steps,
        status=status,
        reason=reason,
        rule=rule,
    )


def _status(result, max_steps: int) -> tuple[str, str]:
    if result == optx.RESULTS.successful:
        return "converged", "The next step would change the objective by less than the tolerance."
    if result == optx.RESULTS.nonlinear_max_steps_reached:
        return "not converged", f"Stopped after {max_steps} steps; raise max_steps, or the hyperparameter."
    return "stalled", "No shorter step lowered the objective; the model is at odds with the data."
