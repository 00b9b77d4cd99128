"""Nonlinear least squares estimate of the conductivity from a frame of voltages (`reconstruct`)."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_has_values, object_text
from jeit.forward import ForwardModel
from jeit.forward.model import channel_voltages, evaluate, fields_and_impedance_of, jacobian_blocks, voltages_of
from jeit.forward.system import check_conductivity
from jeit.inverse.channels import Data
from jeit.inverse.hyperparameter.choice import Choice
from jeit.inverse.hyperparameter.rules import Rule, choose
from jeit.inverse.nonlinear.parametrisation import Parametrisation, as_parametrisation
from jeit.inverse.nonlinear.problem import (
    Inversion,
    check_background,
    check_frame,
    check_noise,
    independent_data,
    keep_informed_shapes,
)
from jeit.inverse.nonlinear.solvers import (
    LBFGSB,
    SOLVERS,
    AbstractSolver,
    GaussNewton,
    LevenbergMarquardt,
    as_solver,
)
from jeit.inverse.prior.matern import DEFAULT_PRIOR
from jeit.inverse.prior.priors import AbstractPrior, check_prior
from jeit.inverse.spectrum import Spectrum
from jeit_solvers import Status
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled, on_device, on_host
from jeit_solvers.module import Module


class Reconstruction(Module):
    """Result of `reconstruct`.

    **Fields**: `conductivity` (m,): S/m (2-D: S); `voltages` (M,): predicted voltages; `misfit`: root mean square of
    predicted - measured voltages over the channels used, in standard deviations (about 1 if only noise is left);
    `costs`: objective at the start and at every accepted iterate (only at start and end if a solver does not record
    it); `iterations`: number of iterations; `outcome`: number of the `Status` with which the solver ended; `reason`: a
    sentence on how the solver ended; `choice`: choice of the hyperparameter λ; `inversion`, `coefficients`: the problem
    solved and its solution, for warm starts and uncertainty; `model`: forward model changed by the estimated unknowns.

    **Example:**

    ```python
    image = reconstruct(model, voltages, 1.0, hyperparameter=1.0)
    image.conductivity, image.misfit, image.status
    ```
    """

    conductivity: Float[Array, " m"]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    costs: Float[Array, " steps"]
    coefficients: Float[Array, " n"]
    inversion: Inversion
    model: ForwardModel
    choice: Choice
    iterations: int | Int[Array, ""]
    outcome: int | Int[Array, ""]
    reason: str = eqx.field(static=True)

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"Reconstruction({self.status}: {self.conductivity.shape[-1]} cells, "
                f"{int(self.iterations)} iterations, "
                f"misfit {float(self.misfit):.2g} standard deviations)"
            ),
            self,
        )

    @property
    def status(self) -> Status:
        """How the solver ended: "converged", "step limit", "stalled" or "failed".

        Raises `ValueError` inside `jax.jit`, where the outcome is not known yet, and for a batch of reconstructions;
        use `converged` there.
        """
        return Status.of_number(self.outcome)

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether the solver converged; also available inside `jax.jit` and for a batch of reconstructions."""
        return jnp.asarray(self.outcome) == Status.CONVERGED.number

    @property
    def hyperparameter(self) -> Float[Array, ""]:
        """Hyperparameter λ, the weight of the prior."""
        return self.choice.hyperparameter

    @property
    def rule(self) -> str:
        """Name of the rule that chose λ."""
        return self.choice.rule

    @property
    def unknowns(self) -> dict[str, Float[Array, " k"]]:
        """Quantities estimated along with the conductivity, by the class name of the unknown.

        `ContactImpedance`: (L,), ohm·m² (2-D: ohm·m); `ElectrodePosition`: displacement, metres; `Scale`: factor;
        `Background`: constant added to the image, on the link's scale.
        """
        model, unknown_values = self.inversion.model, self.inversion.values(self.coefficients)
        return {
            type(unknown).__name__: unknown.quantity(model, unknown_value)
            for unknown, unknown_value in zip(self.inversion.unknowns, unknown_values, strict=True)
        }


def reconstruct(
    model: ForwardModel,
    voltages: Float[Array, " M"],
    background: ArrayLike,
    *,
    prior: AbstractPrior | None = None,
    hyperparameter: float | str | Rule | None = None,
    noise: Float[Array, " M"] | float | None = None,
    mask: Bool[Array, " M"] | None = None,
    solver: AbstractSolver | optx.AbstractLeastSquaresSolver | str | None = None,
    parametrisation: Parametrisation | None = None,
    start: Reconstruction | None = None,
) -> Reconstruction:
    """Estimate the conductivity per cell that explains measured voltages: an absolute image.

    If λ is a number, `reconstruct` works inside `jax.grad`, `jax.jacfwd`, `jax.vmap` and `jax.jit`, with respect to
    voltages, background, noise, λ, the prior's settings and all fields of the model. Derivatives are those of the
    minimum by the implicit function theorem with the full Hessian, even if the solver stopped early. With bounds,
    derivatives are taken at fixed active bounds, so they are one-sided where a bound is just reached. See
    docs/explanation/derivatives.md.

    Tarantola, Inverse Problem Theory (SIAM 2005), ch. 3; Nocedal and Wright, Numerical Optimization (2006), ch. 10.

    **Arguments:**

    - `model`: the forward model.
    - `voltages` (M,): measured voltages, volts.
    - `background`: conductivity of the prior mean and of the starting point, one number or (m,), S/m (2-D: S);
      `calibrate` estimates it.
    - `prior`: `Noser()` by default; `TotalVariation()` for piecewise constant images.
    - `hyperparameter`: weight λ of the prior, or a rule in `jeit.inverse.RULES` that chooses λ for the problem
      linearised at the background; default "noise-figure". Total variation requires a number, default 300.
    - `noise`: standard deviation of the channels in volts, one number or (M,); default 1 % of the voltages, see
      `relative_noise`.
    - `mask` (M,): True for the channels to use.
    - `solver`: a solver such as `LevenbergMarquardt(max_steps=60)`, its name, or a least-squares solver of optimistix
      (not with total variation). Default `GaussNewton()`; with bounds `LBFGSB()`; with further unknowns
      `LevenbergMarquardt(max_steps=100)`.
    - `parametrisation`: the quantities that are estimated: link, bounds, regions in which all cells share one value,
      further unknowns.
    - `start`: an earlier reconstruction of the same kind, from which the iteration starts.

    Raises `ValueError` for invalid or inconsistent arguments; a failure of the solver is reported in the result's
    `status`.

    **Example:**

    ```python
    image = reconstruct(model, voltages, 1.0, hyperparameter=1.0)
    image.conductivity.max(), image.misfit
    ```
    """
    measured_voltages, is_used_channel = check_frame(model, voltages, mask)
    prior = DEFAULT_PRIOR if prior is None else prior
    check_prior(prior)
    parametrisation = as_parametrisation(parametrisation)
    parametrisation.check_model(model)
    background = check_background(model, background)
    noise_deviation = check_noise(noise, measured_voltages, is_used_channel)
    solver = _choose_solver(solver, prior, parametrisation)
    coefficient_bounds = parametrisation.box(background) if solver.keeps_bounds else None
    _check_protocol(model, is_used_channel)
    may_use_numpy = not (parametrisation.unknowns or solver.keeps_bounds or solver.needs_squares)
    independent_model, independent_voltages = independent_data(
        model, measured_voltages, is_used_channel, noise_deviation, at_once=may_use_numpy
    )
    inversion, choice = pose_least_squares(
        independent_model,
        independent_voltages,
        background,
        prior,
        hyperparameter,
        parametrisation,
        per_cell=solver.keeps_bounds,
    )
    if parametrisation.informative and inversion.penalty.is_standard_normal:
        advice_to_user = "leave it out, and take all shapes"
        check_has_values(
            "informative: the problem", inversion, "shapes that the data support come from", advice_to_user
        )
        inversion = keep_informed_shapes(inversion, parametrisation.informative)
    start_coefficients = (
        as_array(np.zeros(inversion.num_coefficients))
        if start is None
        else _start_coefficients(start, inversion, choice)
    )
    solver_solution = solver.minimise(inversion, start_coefficients, coefficient_bounds)
    coefficients, status, reason_of_end = solver_solution.coefficients, solver_solution.status, solver_solution.reason
    fitted_model, conductivity = (
        inversion.with_applied_unknowns(model, coefficients),
        _conductivity(inversion, coefficients),
    )
    predicted_voltages = evaluate(fitted_model, voltages_of, conductivity)
    xp = jnp if not has_values(predicted_voltages, measured_voltages, noise_deviation) else np
    used_indices = np.flatnonzero(is_used_channel)
    normalised_residual = (
        (xp.asarray(predicted_voltages) - xp.asarray(measured_voltages)) / xp.asarray(noise_deviation)
    )[used_indices]
    if xp is jnp or not isinstance(status, Status):
        is_invalid = ~(jnp.isfinite(conductivity).all() & jnp.isfinite(normalised_residual).all())
        status_number = status.number if isinstance(status, Status) else status
        final_status_number = jnp.where(is_invalid, Status.FAILED.number, status_number)
    elif not (np.isfinite(conductivity).all() and np.isfinite(normalised_residual).all()):
        final_status_number = Status.FAILED.number
        reason_of_end = "Conductivity or voltages are NaN; give better data, more noise or a greater λ."
    else:
        final_status_number = status.number
        reason_of_end += (
            ""
            if status == Status.CONVERGED
            else _mismatch_reason(model, measured_voltages[used_indices], background, used_indices)
        )
    return Reconstruction(
        conductivity=conductivity,
        voltages=predicted_voltages,
        misfit=as_array(xp.sqrt(xp.mean(normalised_residual**2))),
        costs=solver_solution.costs + inversion.data.rest / 2,
        coefficients=coefficients,
        inversion=on_device(inversion),
        model=fitted_model,
        choice=choice,
        iterations=solver_solution.iterations,
        outcome=final_status_number,
        reason=reason_of_end,
    )


def _check_protocol(model: ForwardModel, is_used) -> None:
    if not is_used.all():
        advice_to_user = "close over the model, and put into it what varies, such as model.with_electrodes(electrodes)"
        check_has_values(
            "model: its protocol", model.protocol, "to leave out the channels of a mask takes", advice_to_user
        )


def _default_solver(parametrisation: Parametrisation) -> AbstractSolver:
    """Return the default solver. With further unknowns, such as the positions of electrodes, voltages are so nonlinear
    that the line search of Gauss-Newton often leads nowhere; Levenberg-Marquardt mostly converges in 10 to 70 steps."""
    if parametrisation.bounds is not None:
        return LBFGSB()
    return LevenbergMarquardt(max_steps=100) if parametrisation.unknowns else GaussNewton()


def _choose_solver(solver, prior: AbstractPrior, parametrisation: Parametrisation) -> AbstractSolver:
    """Return the requested `solver`, or the default solver for the prior and the parametrisation. Raises `ValueError`
    if the solver cannot solve a problem with this prior and parametrisation."""
    if solver is None:
        return _default_solver(parametrisation)
    solver = as_solver(solver)
    if parametrisation.bounds is not None and not solver.keeps_bounds:
        names = " or ".join(name for name, solver_type in SOLVERS.items() if solver_type().keeps_bounds)
        raise ValueError(
            f"bounds: {solver.name} knows none; use {names}, or leave the solver out, or take link=Bounded(lower, "
            "upper) in place of bounds."
        )
    if solver.needs_squares and not prior.is_quadratic:
        raise ValueError("solver: total variation is not a sum of squares; use gauss-newton or levenberg-marquardt.")
    return solver


@np.errstate(all="ignore")  # a problem that is not finite is reported when it is solved
def pose_least_squares(
    model: ForwardModel,
    data: Data,
    background: Float[Array, " m"],
    prior: AbstractPrior,
    hyperparameter: float | str | Rule | None,
    parametrisation: Parametrisation,
    *,
    per_cell: bool = False,
) -> tuple[Inversion, Choice]:
    """Set up the least squares problem for a `model` of independent channels and their `data`, and choose λ.

    `per_cell`: whether every coefficient must be the value of a cell, as bounds require. Raises `ValueError` for
    invalid or inconsistent arguments.
    """
    mesh, conductivity_link = model.mesh, parametrisation.link
    reference_estimate, regions = conductivity_link.estimate(background), parametrisation.regions_of(mesh)
    requested_hyperparameter = prior.default_hyperparameter if hyperparameter is None else hyperparameter
    is_rule_requested = isinstance(requested_hyperparameter, str) or callable(requested_hyperparameter)
    if prior.is_quadratic:
        predicted_voltages, whitened_jacobian, whitening_data = _whitened_jacobian(
            model, data, background, conductivity_link.slope(reference_estimate)
        )
        jacobian_spectrum = whitened_difference = None
        if is_rule_requested:
            jacobian_spectrum = Spectrum.create(
                whitened_jacobian, prior.covariance_product(mesh, whitened_jacobian), prior.null_space(mesh)
            )
            whitened_difference = whitening_data.whiten(
                whitening_data.weight * (whitening_data.voltages - predicted_voltages)
            )
        choice = choose(jacobian_spectrum, requested_hyperparameter, whitened_difference, mesh)
    elif is_rule_requested:
        raise ValueError(f"hyperparameter: total variation takes a number, not the rule {requested_hyperparameter!r}.")
    else:
        whitened_jacobian, choice = None, choose(None, requested_hyperparameter, None)
    penalty_weight = float(choice.hyperparameter) if has_values(choice.hyperparameter) else choice.hyperparameter
    basis, penalty = prior.penalty(
        mesh, reference_estimate, penalty_weight, jacobian=whitened_jacobian, regions=regions, per_cell=per_cell
    )
    inversion = Inversion(model, data, conductivity_link, reference_estimate, basis, penalty, parametrisation.unknowns)
    return inversion if namespace(model) is np else on_device(inversion), choice


def _whitened_jacobian(model: ForwardModel, data: Data, background, slope):
    """Voltages of the background, whitened Jacobian at the background with respect to the link's variable, and the
    data; as NumPy arrays unless traced."""
    if not has_values(model, data, background, slope):
        voltages, jacobian = model.voltages_and_jacobian(background)
        return voltages, data.whiten(data.weight[:, None] * jacobian * slope), data
    host_data, slope = on_host((data, slope))
    fields, impedance = on_host(evaluate(model, fields_and_impedance_of, check_conductivity(model.mesh, background)))
    mesh, protocol = on_host((model.mesh, model.protocol))
    whitening_matrix = host_data.whiten(np.diag(host_data.weight))
    whitened_jacobian: Any = np.empty((len(whitening_matrix), mesh.num_cells))
    for cells, jacobian_block in jacobian_blocks(mesh, protocol, fields):
        whitened_jacobian[:, cells] = whitening_matrix @ (jacobian_block * slope[cells])
    return channel_voltages(protocol, impedance), whitened_jacobian, host_data


def _start_coefficients(previous_reconstruction, inversion: Inversion, choice: Choice) -> Float[Array, " n"]:
    """Coefficients of `previous_reconstruction`, rescaled to the λ of `choice`. Raises `ValueError` if the
    problem of the earlier reconstruction is of a different kind."""
    if not isinstance(previous_reconstruction, Reconstruction):
        raise ValueError(f"start must be what reconstruct has returned, not {type(previous_reconstruction).__name__}.")
    if previous_reconstruction.coefficients.shape != (inversion.num_coefficients,) or not _have_same_unknowns(
        previous_reconstruction.inversion, inversion
    ):
        raise ValueError(
            f"start has {previous_reconstruction.coefficients.size} coefficients of another kind of problem; this one "
            f"has {inversion.num_coefficients}. Give a reconstruction of the same model, prior and link."
        )
    num_coefficients = inversion.basis.num_coefficients
    hyperparameter_ratio = (
        choice.hyperparameter / previous_reconstruction.choice.hyperparameter
        if inversion.penalty.is_standard_normal
        else 1.0
    )
    return previous_reconstruction.coefficients.at[:num_coefficients].multiply(hyperparameter_ratio)


def _have_same_unknowns(first_inversion: Inversion, second_inversion: Inversion) -> bool:
    """Whether two problems have the same types of link, basis, penalty and unknowns, so that their coefficients agree
    in meaning."""

    def component_types(inversion):
        return [
            type(inversion_component)
            for inversion_component in (inversion.link, inversion.basis, inversion.penalty, *inversion.unknowns)
        ]

    return component_types(first_inversion) == component_types(second_inversion)


def _mismatch_reason(model: ForwardModel, measured, background, used_indices) -> str:
    """Sentence on wrong units or polarity if measured voltages and those of the background differ in size or sign."""
    background_voltages = np.asarray(model.voltages(background))[used_indices]
    voltage_ratio = float(np.asarray(measured) @ background_voltages / (background_voltages @ background_voltages))
    if 0.1 < voltage_ratio < 10:
        return ""
    return (
        f" The voltages are {voltage_ratio:.2g} times those of the background; are they in volts, and their signs "
        "right?"
    )


@numpy_or_compiled
def _conductivity(inversion: Inversion, coefficients):
    return inversion.conductivity(coefficients)
