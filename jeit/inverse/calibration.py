"""Calibration: fit of background conductivity and contact impedance to a frame of the undisturbed body."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy
from jaxtyping import Array, Bool, Float, Inexact, Int

from jeit.arguments import check_name, object_text, percent
from jeit.forward import ForwardModel
from jeit.forward.changes import ContactSensitivity
from jeit.forward.model import check_model, select_channels
from jeit.inverse.linearisation import check_mask
from jeit.inverse.nonlinear.problem import check_steps
from jeit_solvers import Status, as_minimum, ended_number, symmetric_inverse
from jeit_solvers.engines import as_array, has_values, on_device, on_host, undifferentiated
from jeit_solvers.module import Module

# Logarithm of the ratio of a contact impedance to the model's, beyond which the impedance no longer changes the
# voltages.
MAX_LOG_CONTACT_RATIO = 50.0
# Tolerance of the parameters and the misfit in a fit inside jax.jit, jax.grad or jax.vmap: as small as double precision
# allows.
_TRACED_TOLERANCE = 1e-12


class TracedFit(NamedTuple):
    """Result of `traced_fit`; fields as in `Calibration`."""

    model: ForwardModel
    conductivity: Float[Array, ""]
    voltages: Float[Array, " M"]
    misfit: Float[Array, ""]
    contact_deviation: Float[Array, " k"]
    iterations: Int[Array, ""]
    outcome: Int[Array, ""]


@eqx.filter_jit
def traced_fit(model: ForwardModel, measured: Float[Array, " M"], is_used, contact: str, max_steps: int) -> TracedFit:
    """Fit the logarithms of the conductivity σ and of z·σ / z₀, with contact impedances z and those of the model z₀, to
    the channels `is_used` by least squares, inside a JAX transformation; see `calibrate`."""
    problem = on_device((model, measured, is_used))
    unit_voltages = jnp.where(is_used, model.voltages(1.0), 0)
    num_parameters = {"fixed": 1, "common": 2, "each": 1 + model.electrodes.num_electrodes}[contact]
    start_parameters = jnp.full(
        num_parameters, jnp.log(unit_voltages @ unit_voltages / (unit_voltages @ jnp.where(is_used, measured, 0)))
    )
    optimiser = optx.LevenbergMarquardt(rtol=_TRACED_TOLERANCE, atol=_TRACED_TOLERANCE)
    residual = partial(_relative_residual, contact)
    frozen_start, frozen_problem = undifferentiated((start_parameters, problem))
    fit_solution = optx.least_squares(
        residual, optimiser, frozen_start, frozen_problem, max_steps=max_steps, throw=False
    )
    parameters = as_minimum(
        fit_solution.value, problem, partial(_misfit_gradient, contact), partial(_normal_equations_solver, contact)
    )
    fitted_model, conductivity = _fitted_model(contact, parameters, model)
    final_residual = residual(parameters, problem)
    covariance = symmetric_inverse(_normal_matrix(contact, parameters, problem))
    degrees_of_freedom = jnp.maximum(jnp.sum(is_used) - num_parameters, 1)
    relative_deviation = jnp.sqrt(covariance.diagonal() * (final_residual @ final_residual) / degrees_of_freedom)[1:]
    misfit = jnp.sqrt(final_residual @ final_residual)
    status_number = jnp.where(jnp.isfinite(misfit), ended_number(fit_solution.result), Status.FAILED.number)
    num_steps = fit_solution.stats["num_steps"]
    return TracedFit(
        fitted_model,
        conductivity,
        fitted_model.voltages(conductivity),
        misfit,
        relative_deviation,
        num_steps,
        status_number,
    )


def _fitted_model(contact: str, parameters, model: ForwardModel) -> tuple[ForwardModel, Any]:
    """Model and conductivity for these parameters."""
    conductivity = jnp.exp(parameters[0])
    if contact == "fixed":
        return model, conductivity
    impedance_ratio = jnp.exp(jnp.clip(parameters[1:] - parameters[0], -MAX_LOG_CONTACT_RATIO, MAX_LOG_CONTACT_RATIO))
    impedance = model.electrodes.contact_impedance * impedance_ratio
    return model.with_electrodes(model.electrodes.with_contact_impedance(impedance)), conductivity


def _relative_residual(contact: str, parameters, problem):
    """Residual (predicted - measured) / ‖measured‖ (M,) of the channels in use, zero for the other channels."""
    model, measured_voltages, is_used = problem
    fitted_model, conductivity = _fitted_model(contact, parameters, model)
    predicted_voltages = fitted_model.voltages(conductivity)
    return jnp.where(is_used, predicted_voltages - measured_voltages, 0) / jnp.linalg.norm(
        jnp.where(is_used, measured_voltages, 0)
    )


def _misfit_gradient(contact: str, parameters, problem):
    """Gradient (p,) of half the sum of squared residuals with respect to the parameters."""
    return jax.grad(
        lambda trial_parameters: 0.5 * jnp.sum(_relative_residual(contact, trial_parameters, problem) ** 2)
    )(parameters)


def _normal_matrix(contact: str, parameters, problem):
    """Normal matrix JᵀJ (p, p) of the fit, with the Jacobian J of the residual."""
    jacobian = jax.jacfwd(lambda trial_parameters: _relative_residual(contact, trial_parameters, problem))(parameters)
    return jacobian.T @ jacobian


def _normal_equations_solver(contact: str, parameters, problem):
    """Function that multiplies a vector by the inverse of the normal matrix JᵀJ."""
    inverse_normal_matrix = symmetric_inverse(_normal_matrix(contact, parameters, problem))
    return lambda right_side: inverse_normal_matrix @ right_side


_REASON_BY_STATUS = {
    Status.STEP_LIMIT: "Stopped after {} steps.",
    Status.FAILED: "The fit became NaN.",
}
_TRACED_REASON = "It was fitted inside a transformation of JAX; the status says how that ended."

# Relative misfit above which `Calibration.note` doubts the model. The misfit is 1 % for the KIT4 tanks and 8 % for the
# tank of the Kuopio challenge, whose geometries are known.
_LARGE_MISFIT = 0.12
# The largest voltage of a frame, in volts, must lie between this number and its reciprocal.
_MIN_VOLTAGE = 1e-30
# Relative change of the misfit or the parameters that ends a fit: on small meshes, and on large meshes.
_FIT_TOLERANCE, _LARGE_MESH_FIT_TOLERANCE = 1e-8, 1e-4
# Number of cells above which a mesh counts as large. A step of the fit on a large mesh takes seconds.
_LARGE_MESH_CELLS = 30_000


class Calibration(Module):
    """A forward model fitted to a reference frame.

    **Fields**: `model`: the model with fitted contact impedance; `conductivity`: uniform background (S/m; 2-D: S),
    complex if the voltages are; `voltages` (M,): voltages predicted by the fitted model; `misfit`: ‖predicted -
    measured‖ / ‖measured‖ over the channels used; `contact_deviation` (k,): standard deviations of the logarithms of
    the k fitted contact impedances, estimated from the residuals; `iterations`: number of iterations; `outcome`: number
    of the `Status` with which the fit ended; `reason`: a sentence on why the fit did not converge, empty if it
    converged; `shift` (L, a): displacements of each electrode along its a directions, metres, if their positions were
    estimated (`jeit.inverse.placement`), else None; `model_error`: the `ModelError` of positions and contact
    impedances, if estimated, else None.

    **Example:**

    ```python
    fit = calibrate(model, reference)
    fit.conductivity, fit.misfit, fit.model.electrodes.contact_impedance
    ```
    """

    model: ForwardModel
    conductivity: Inexact[Array, ""]
    voltages: Inexact[Array, " M"]
    misfit: Float[Array, ""]
    contact_deviation: Float[Array, " k"]
    iterations: int | Int[Array, ""]
    outcome: int | Int[Array, ""]
    reason: str = eqx.field(static=True, default="")
    shift: Float[Array, "L a"] | None = None
    model_error: Any = None

    def __repr__(self) -> str:
        return object_text(
            lambda: (
                f"Calibration({self.status}: conductivity {complex(self.conductivity).real:.3g}, "
                f"misfit {percent(float(self.misfit))},\n  {type(self.model.electrodes).__name__}, {self.model.mesh!r})"
            ),
            self,
        )

    @property
    def status(self) -> Status:
        """How the fit ended: "converged", "step limit" or "failed".

        Raises `ValueError` inside `jax.jit`, where the outcome is not known yet, and for a batch of fits.
        """
        return Status.of_number(self.outcome)

    @property
    def distinguishes_contacts(self) -> bool:
        """Whether the fit converged and determines every fitted contact impedance to within a factor of three."""
        return bool(self.status == Status.CONVERGED and (self.contact_deviation < 1).all())

    @property
    def note(self) -> str:
        """Sentence on estimated electrode positions, or else on a large misfit; empty if neither applies."""
        if self.shift is not None:
            shifts_in_mm = 1e3 * np.linalg.norm(np.asarray(self.shift), axis=1)
            return (
                f"electrodes were estimated to be up to {shifts_in_mm.max():.2g} mm from where they are described "
                f"(root mean square {np.sqrt(np.mean(shifts_in_mm**2)):.2g} mm), which explains the reference far "
                "better. If the description is exact, look for another cause: contacts, channels, order."
            )
        if not float(self.misfit) > _LARGE_MISFIT:
            return ""
        if self.model.mesh.dimension == 3:
            possible_errors, further_errors = (
                "size of the body, how high it is filled, places and sizes of the electrodes",
                "",
            )
        else:
            possible_errors, further_errors = "radius, width of the electrodes", ", or the body deeper than a sheet"
        return (
            f"the model misses {100 * float(self.misfit):.0f} % of the reference: {possible_errors}, protocol or "
            f"gain may be others than described{further_errors}. An error that is the same in both frames hardly moves "
            "the image of a change; but do not trust the size of the change, nor the background conductivity."
        )


def calibrate(
    model: ForwardModel,
    voltages: Inexact[Array, " M"],
    *,
    mask: Bool[Array, " M"] | None = None,
    contact: str = "common",
    max_steps: int = 100,
) -> Calibration:
    """Fit background conductivity and contact impedance to a reference frame by least squares.

    The parameters are logarithms, so conductivity and impedance stay positive. The fit starts from the model's contact
    impedance and from the conductivity for which the prediction for σ = 1, divided by σ, fits the data best (voltages
    are proportional to 1/σ at fixed z·σ). For complex voltages the background σ + iωε is complex, with the two parts of
    its logarithm as parameters; contact impedances stay real.

    The function works inside `jax.grad`, `jax.vmap` and `jax.jit`, with respect to the voltages and all fields of the
    model. Derivatives of the minimum follow from the implicit function theorem with the full Hessian.

    **Arguments:**

    - `model`: the forward model.
    - `voltages` (M,): voltages of the undisturbed body, such as the empty tank, volts.
    - `mask` (M,): True for the channels to use.
    - `contact`: "common" fits one factor of the model's contact impedance for all electrodes; "each" fits one factor
      per electrode; "fixed" keeps the model's contact impedance.
    - `max_steps`: maximum number of steps.

    Raises `ValueError` for a frame of the wrong shape or without signal.

    **Example:**

    ```python
    fit = calibrate(model, reference)
    fit.conductivity, fit.misfit
    ```
    """
    check_model(model)
    check_mask(mask)
    measured_voltages = np.asarray(voltages) if has_values(voltages) else jnp.asarray(voltages)
    number_type = complex if measured_voltages.dtype.kind == "c" else float
    if measured_voltages.dtype.kind not in "biufc":
        raise ValueError(f"voltages are {measured_voltages.dtype}; give numbers, in volts.")
    measured_voltages = measured_voltages.astype(number_type)
    frame_shape = (model.protocol.num_measurements,)
    is_used = np.ones(frame_shape, bool) if mask is None else np.asarray(mask)
    if measured_voltages.shape != frame_shape or is_used.shape != frame_shape or is_used.dtype != bool:
        raise ValueError(
            f"voltages has shape {measured_voltages.shape} and mask {is_used.shape} of {is_used.dtype}; protocol "
            f"'{model.protocol.name}' has {frame_shape}, and the mask must be booleans."
        )
    check_name("contact", contact, ("common", "each", "fixed"))
    max_steps = check_steps("max_steps", max_steps)
    if not has_values(model, measured_voltages):
        if number_type is complex:
            raise ValueError(
                "voltages are complex, and inside jax.jit, jax.grad or jax.vmap only real ones can be fitted. Call "
                "calibrate outside these functions, or fit the real parts, calibrate(model, voltages.real)."
            )
        contact = "fixed" if model.electrodes.is_point else contact
        return Calibration(
            *traced_fit(model, jnp.where(is_used, measured_voltages, 0), is_used, contact, max_steps), _TRACED_REASON
        )
    measured_voltages = np.where(is_used, measured_voltages, 0)
    max_voltage = np.abs(measured_voltages).max()
    if not np.isfinite(max_voltage) or max_voltage == 0:
        raise ValueError("voltages: the reference frame has no finite, non-zero values to calibrate on.")
    if not _MIN_VOLTAGE < max_voltage < 1 / _MIN_VOLTAGE:
        raise ValueError(f"voltages: the largest of the reference frame is {max_voltage:.3g} V; are they in volts?")
    with np.errstate(all="ignore"):
        return _fit_parameters(model, measured_voltages, is_used, contact, max_steps)


def _fit_parameters(model: ForwardModel, measured_voltages, is_used, contact: str, max_steps: int) -> Calibration:
    if model.electrodes.is_point:
        contact = "fixed"
    data_norm = np.linalg.norm(measured_voltages)
    # The starting conductivity is that with which the model's voltages fit the data best.
    unit_voltages = np.where(is_used, model.voltages(1.0), 0)
    if not (unit_voltages @ measured_voltages).real > 0:
        raise ValueError(
            "voltages: they have the opposite sign of the model's. Is the polarity of drive or measurement turned "
            "round, or the order of the channels another than the protocol's?"
        )
    is_complex = np.iscomplexobj(measured_voltages)
    problem = _CalibrationProblem(model, contact, is_complex)
    conductivity = np.log(unit_voltages @ unit_voltages / (unit_voltages @ measured_voltages))
    start_parameters = np.full(problem.num_parameters, conductivity.real)
    if is_complex:
        start_parameters[1] = conductivity.imag

    def real_and_imaginary_parts(complex_residuals):
        return np.concatenate([complex_residuals.real, complex_residuals.imag]) if is_complex else complex_residuals

    def residual(parameters):
        return real_and_imaginary_parts(
            np.where(is_used, problem.voltages(parameters) - measured_voltages, 0) / data_norm
        )

    def jacobian(parameters):
        return real_and_imaginary_parts(np.where(is_used[:, None], problem.jacobian(parameters), 0) / data_norm)

    fit_tolerance = _LARGE_MESH_FIT_TOLERANCE if model.mesh.num_cells > _LARGE_MESH_CELLS else _FIT_TOLERANCE
    solver_options: dict[str, Any] = {
        "ftol": fit_tolerance,
        "xtol": fit_tolerance,
        "gtol": None,
        "max_nfev": max_steps,
        "jac": jacobian,
    }
    fit_solution = scipy.optimize.least_squares(residual, start_parameters, **solver_options)
    fitted_model, conductivity = problem.model(fit_solution.x)
    voltages = as_array(problem.voltages(fit_solution.x))
    misfit = as_array(np.linalg.norm(residual(fit_solution.x)))
    status = Status.CONVERGED if fit_solution.status > 0 else Status.STEP_LIMIT
    status = status if np.isfinite(misfit) else Status.FAILED
    reason_of_end = "" if status == Status.CONVERGED else _REASON_BY_STATUS[status].format(max_steps)
    contact_deviation: Any = _standard_deviations(fit_solution)[problem.first_contact :]
    return Calibration(
        fitted_model,
        as_array(conductivity),
        voltages,
        misfit,
        contact_deviation,
        int(fit_solution.njev),
        status.number,
        reason_of_end,
    )


def _standard_deviations(fit_solution: "scipy.optimize.OptimizeResult") -> Float[np.ndarray, " p"]:
    """Standard deviations of the fitted parameters, estimated from the Jacobian and the residuals as if the residuals
    were independent errors of equal variance."""
    _, singular_values, right_vectors = np.linalg.svd(fit_solution.jac, full_matrices=False)
    degrees_of_freedom = max(np.count_nonzero(fit_solution.fun) - len(fit_solution.x), 1)
    return np.linalg.norm(right_vectors / singular_values[:, None], axis=0) * np.sqrt(
        2 * fit_solution.cost / degrees_of_freedom
    )


class _CalibrationProblem:
    """Voltages as a function of two kinds of parameters: log σ, for the conductivity σ, and log (z·σ / z₀), one number
    or one number per electrode, for the contact impedance z and that of the model z₀.

    Voltages are proportional to 1/σ at fixed z·σ, so these parameters are nearly uncorrelated. For a complex
    admittivity γ, the first two parameters are log |γ| and the phase.
    """

    def __init__(self, model: ForwardModel, contact: str, is_complex: bool):
        self.initial_model, self.contact, self.is_complex = model, contact, is_complex
        self.select = partial(select_channels, on_host(model.protocol))
        self.sensitivity = None if model.electrodes.is_point else ContactSensitivity(model.mesh, model.electrodes)
        self.cached_fields: tuple[bytes, Any] | None = None

    @property
    def num_parameters(self) -> int:
        """Number of parameters: one for the conductivity, or two if the conductivity is complex, plus the contact
        impedances."""
        return (
            self.first_contact
            + {"fixed": 0, "common": 1, "each": self.initial_model.electrodes.num_electrodes}[self.contact]
        )

    @property
    def first_contact(self) -> int:
        """Index of the first contact impedance among the parameters."""
        return 2 if self.is_complex else 1

    def model(self, parameters) -> tuple[ForwardModel, float | complex]:
        """Model and conductivity for these parameters."""
        conductivity = np.exp(parameters[0] + 1j * parameters[1]) if self.is_complex else np.exp(parameters[0])
        if self.contact == "fixed":
            return self.initial_model, conductivity
        electrodes = self.initial_model.electrodes
        impedance_ratio = np.exp(
            np.clip(parameters[self.first_contact :] - parameters[0], -MAX_LOG_CONTACT_RATIO, MAX_LOG_CONTACT_RATIO)
        )
        impedance = np.asarray(electrodes.contact_impedance) * impedance_ratio
        return self.initial_model.with_electrodes(electrodes.with_contact_impedance(impedance)), conductivity

    def voltages(self, parameters):
        """Voltages (M,) in volts for these parameters."""
        return self.select(self._model_fields_and_impedance(parameters)[2])

    def jacobian(self, parameters):
        """Derivatives of the voltages with respect to the parameters, (M, p) volts."""
        model, fields, impedance = self._model_fields_and_impedance(parameters)
        conductivity_derivative = -self.select(impedance)[:, None]
        if self.sensitivity is None:
            return self._add_phase_derivative(conductivity_derivative, conductivity_derivative)
        contact_derivatives = self.sensitivity(fields, impedance, model.electrodes.contact_impedance)
        contact_columns = np.stack(
            [self.select(contact_derivative) for contact_derivative in contact_derivatives], axis=1
        )
        derivative_at_fixed_contact = conductivity_derivative + contact_columns.sum(
            axis=1, keepdims=True
        )  # z·σ is proportional to σ
        if self.contact == "fixed":
            return self._add_phase_derivative(derivative_at_fixed_contact, derivative_at_fixed_contact)
        chosen_contact_columns = (
            contact_columns if self.contact == "each" else contact_columns.sum(axis=1, keepdims=True)
        )
        return np.concatenate(
            [self._add_phase_derivative(conductivity_derivative, derivative_at_fixed_contact), chosen_contact_columns],
            axis=1,
        )

    def _add_phase_derivative(self, magnitude_derivative, derivative_at_fixed_contact):
        """Columns of the Jacobian: derivatives of the voltages with respect to log |γ| and, for a complex admittivity
        γ, with respect to its phase at fixed contact impedance."""
        return (
            np.concatenate([magnitude_derivative, 1j * derivative_at_fixed_contact], axis=1)
            if self.is_complex
            else magnitude_derivative
        )

    def _model_fields_and_impedance(self, parameters):
        """Model, fields and transfer impedance for these parameters; the last result is cached."""
        parameter_bytes = parameters.tobytes()
        if self.cached_fields is None or self.cached_fields[0] != parameter_bytes:
            model, conductivity = self.model(parameters)
            self.cached_fields = parameter_bytes, (model, *on_host(model.fields(conductivity)))
        return self.cached_fields[1]
