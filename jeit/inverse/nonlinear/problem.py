"""The nonlinear least squares problem of `reconstruct`, checks of its arguments, its reduction to informed shapes, and
derivatives of its minimum.

Informed shapes are the few dozen combinations of a prior's shapes (columns of its basis) that the data resolve: right
singular vectors of the whitened Jacobian at the background, stored in single precision, which changes an image by a
relative 1e-6.

Derivatives of the minimum are implicit: at a minimum the gradient of the objective, Jᵀ G r + penalty'(c), is zero. With
bounds, the gradient is zero for the free coefficients. A coefficient at an active bound, where the objective decreases
outwards, follows the bound as long as the bound stays active. Where a bound is just reached, derivatives are one-sided.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jeit.arguments import describe
from jeit.forward import ForwardModel
from jeit.forward.model import (
    channel_voltages,
    check_model,
    evaluate,
    fields_and_impedance_of,
    jacobian_blocks,
    voltages_and_jacobian_of,
    voltages_of,
)
from jeit.inverse.channels import Data, IndependentChannels, relative_noise
from jeit.inverse.linearisation import check_mask, check_positive_noise
from jeit.inverse.nonlinear.parametrisation import AbstractLink, AbstractUnknown
from jeit.inverse.prior.bases import AbstractBasis, DenseBasis, expand_rows
from jeit.inverse.prior.penalties import AbstractPenalty
from jeit_solvers import QuadraticModel, as_minimum, symmetric_eigen, symmetric_inverse
from jeit_solvers.engines import has_values, host, namespace, numpy_or_compiled, on_device, on_host
from jeit_solvers.module import Module

# Relative distance from a bound within which a coefficient counts as being at the bound; solvers scale coefficients and
# bounds, which causes rounding errors.
_BOUND_TOLERANCE = 1e-12


def check_frame(model: ForwardModel, voltages, mask) -> tuple[Float[Array, " M"], np.ndarray]:
    """Voltages (M,) with zeros in channels that the mask leaves out, and the mask as booleans.

    Raises `ValueError` for invalid voltages or masks. The values of traced voltages are not checked.
    """
    check_model(model)
    check_mask(mask)
    voltages = _convert_to_floats(voltages)
    if voltages.dtype.kind == "c":
        raise ValueError(
            "voltages are complex, and this method takes real ones: image their change by one_step, repeatedly for an "
            "absolute image. Real parts and magnitudes alone give biased conductivities."
        )
    if voltages.dtype.kind not in "biuf":
        raise ValueError(f"voltages are {voltages.dtype}; give real numbers, in volts.")
    frame_shape = (model.protocol.num_measurements,)
    measured_voltages = voltages.astype(float)
    is_used_channel = np.ones(frame_shape, bool) if mask is None else np.asarray(mask)
    if measured_voltages.shape != frame_shape or is_used_channel.shape != frame_shape or is_used_channel.dtype != bool:
        raise ValueError(
            f"voltages has shape {measured_voltages.shape} and mask {is_used_channel.shape} of "
            f"{is_used_channel.dtype}; protocol '{model.protocol.name}' has {frame_shape[0]} channels, and the mask "
            "must be booleans."
        )
    if not is_used_channel.any():
        raise ValueError("mask: every channel is left out, so there is nothing to reconstruct from.")
    if not has_values(measured_voltages):
        return jnp.where(is_used_channel, measured_voltages, 0), is_used_channel
    used_voltages = np.asarray(measured_voltages)[is_used_channel]
    if not np.isfinite(used_voltages).all():
        raise ValueError(
            f"voltages: NaN or infinite in {(~np.isfinite(used_voltages)).sum()} of the channels in use; mask them."
        )
    if not used_voltages.any():
        raise ValueError("voltages: all channels in use read zero; was the current source on?")
    return host.where(is_used_channel, measured_voltages, 0), is_used_channel


def check_background(model: ForwardModel, background) -> Float[Array, " m"]:
    """Background conductivity per cell; raises `ValueError` unless `background` is one positive number or one positive
    number per cell."""
    background = _convert_to_floats(background)
    if background.dtype.kind not in "biuf" or background.shape not in ((), (model.mesh.num_cells,)):
        raise ValueError(
            f"background must be one real conductivity, or one for each of the {model.mesh.num_cells} cells; it is "
            f"{background.dtype} of shape {background.shape}."
        )
    background_values = np.asarray(background) if has_values(background) else np.ones(())
    if (invalid_values := background_values[~((background_values > 0) & np.isfinite(background_values))]).size:
        raise ValueError(
            f"background must be positive and finite everywhere, S/m (2-D: S); {describe(invalid_values[0])} is not."
        )
    return namespace(background).broadcast_to(background.astype(float), (model.mesh.num_cells,))


def check_noise(noise, measured: Float[Array, " M"], is_used: np.ndarray) -> Float[Array, " M"]:
    """Standard deviation of every channel in volts, 1 in channels that are not used; raises `ValueError` for invalid
    noise."""
    standard_deviation = np.zeros(()) if noise is None else _convert_to_floats(noise)
    if standard_deviation.shape not in ((), measured.shape) or standard_deviation.dtype.kind not in "iuf":
        raise ValueError(
            f"noise is {standard_deviation.dtype} of shape {standard_deviation.shape}; give one real number, or one "
            "for each channel."
        )
    xp = namespace(standard_deviation, measured)
    noise_deviation = (
        relative_noise(measured, xp.asarray(is_used))
        if noise is None
        else xp.broadcast_to(standard_deviation, measured.shape)
    )
    check_positive_noise(noise_deviation, is_used)
    return xp.where(is_used, noise_deviation, 1)


def _convert_to_floats(values):
    """Copy of `values` as a NumPy array of floats, or as a JAX array if traced."""
    return host.array(values) if has_values(values) else jnp.asarray(values)


def check_steps(name: str, max_steps) -> int:
    """Return `max_steps` as an integer. Raises `ValueError` unless `max_steps` is a whole number of at least 1."""
    if isinstance(max_steps, bool) or not isinstance(max_steps, (int, np.integer)) or max_steps < 1:
        raise ValueError(f"{name} must be a whole number from 1; it is {max_steps!r}.")
    return int(max_steps)


def check_tolerance(name: str, tolerance) -> float:
    """Return `tolerance` as a float. Raises `ValueError` unless 0 ≤ tolerance < 1."""
    if not isinstance(tolerance, (int, float, np.number)) or not 0 <= tolerance < 1:
        raise ValueError(f"{name} must be a number from 0 and less than 1; it is {tolerance!r}.")
    return float(tolerance)


def independent_data(
    model: ForwardModel,
    measured: Float[Array, " M"],
    is_used: Bool[np.ndarray, " M"],
    deviation: Float[Array, " M"],
    *,
    at_once: bool,
) -> tuple[ForwardModel, Data]:
    """Forward model of the independent channels among the channels used, and the data of these independent channels.

    `deviation` (M,): standard deviation of the noise, volts. `at_once`: whether to return NumPy arrays if the model
    supports it.
    """
    used_indices = np.flatnonzero(is_used)
    model_of_used_channels = model if is_used.all() else model.with_protocol(model.protocol.subset(used_indices))
    independent_channels = IndependentChannels.create(model_of_used_channels.protocol)
    independent_model = model_of_used_channels
    if has_values(model_of_used_channels.protocol):
        independent_model = model_of_used_channels.with_protocol(
            model_of_used_channels.protocol.subset(np.asarray(independent_channels.index))
        )
    # For a solid body, compiled programs would hold several copies of the Jacobian.
    if at_once and (model.at_once or model.mesh.dimension == 3) and has_values(independent_model):
        independent_model, independent_channels = on_host(
            (independent_model, independent_channels)
        )  # so that everything computed from these is in NumPy
    return independent_model, independent_channels.weigh(deviation[used_indices]).combine(measured[used_indices])


def keep_informed_shapes(inversion: Inversion, min_signal: float, persistence: float = 0.0) -> Inversion:
    """Reduce a problem to the combinations of the prior's shapes that the data resolve. The penalty must be ½‖c‖².

    `min_signal`: minimum signal of a combination with an amplitude of one prior standard deviation, in standard
    deviations of the noise. `persistence`: fraction of the last image that is expected in the next image; if it is not
    0, the prior variances are those before a frame in the steady state of the Kalman filter.
    """
    squared_singular_values, scaled_right_vectors = (
        np.asarray(singular_array) for singular_array in _singular_values(inversion)
    )
    is_informed_direction = squared_singular_values > max(min_signal**2, 1e-12 * squared_singular_values[-1])
    scale_of_directions = np.sqrt(
        _expected_variance(squared_singular_values[is_informed_direction], persistence)
        / squared_singular_values[is_informed_direction]
    )
    shape_combinations = scale_of_directions[:, None] * scaled_right_vectors[is_informed_direction]
    image_shapes = host.asarray(expand_rows(on_host(inversion.basis), shape_combinations).T, np.float32)
    informed_inversion = eqx.tree_at(lambda problem: problem.basis, inversion, DenseBasis(image_shapes))
    return informed_inversion if namespace(inversion) is np else on_device(informed_inversion)


@numpy_or_compiled
def _singular_values(inversion: Inversion):
    """Squared singular values of the whitened Jacobian at the background with respect to the image's coefficients, and
    its right singular vectors multiplied by the singular values."""
    xp = namespace(inversion)
    zero_coefficients = xp.zeros(inversion.num_coefficients)
    whitened_rows = inversion.data.whiten(inversion.linearise(zero_coefficients)[1])[
        :, : inversion.basis.num_coefficients
    ]
    squared_values, left_vectors = symmetric_eigen(whitened_rows @ whitened_rows.T)
    return squared_values, left_vectors.T @ whitened_rows


def _expected_variance(strength, persistence: float):
    """Variance p of a coefficient before a frame in the steady state of the Kalman filter: p = a² p / (1 + s p) + 1 -
    a², where a is the persistence and s the `strength` of the data, which is the squared singular value of the
    coefficient."""
    innovation_variance = 1 - persistence**2
    half_linear_term = innovation_variance * (1 - strength) / 2
    discriminant_root = np.sqrt(half_linear_term**2 + strength * innovation_variance)
    return np.where(
        half_linear_term > 0,
        innovation_variance / (half_linear_term + discriminant_root),
        (discriminant_root - half_linear_term) / strength,
    )


class Inversion(Module):
    """Minimisation of ½ rᵀ G r + penalty(c) over the coefficients c, with the residual r = w (v(σ) - ŷ) and the
    conductivity σ = link(x₀ + S c).

    **Fields**: `model`: forward model of the independent channels, which predicts v; `data`: measured voltages ŷ,
    weights w and precision G; `link`; `reference` (m,): x₀, on the link's scale; `basis`: S, scaled with the
    hyperparameter; `penalty`; `unknowns`: parameters estimated along with the conductivity, whose values are the last
    coefficients.
    """

    model: ForwardModel
    data: Data
    link: AbstractLink
    reference: Float[Array, " m"]
    basis: AbstractBasis
    penalty: AbstractPenalty
    unknowns: tuple[AbstractUnknown, ...] = ()

    @property
    def is_solvable_in_numpy(self) -> bool:
        """Whether the problem can be solved in NumPy: nothing is traced and there are no unknowns."""
        runs_uncompiled = self.model.at_once or namespace(self.model) is np
        return runs_uncompiled and not self.unknowns and has_values(self)

    @property
    def num_coefficients(self) -> int:
        """Number of coefficients n, including those of the unknowns."""
        return self.basis.num_coefficients + sum(unknown.size for unknown in self.unknowns)

    def conductivity(self, coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
        """Conductivity σ per cell, S/m (2-D: S)."""
        return self.link.conductivity(self.estimate(coefficients))

    def estimate(self, coefficients: Float[Array, " n"]) -> Float[Array, " m"]:
        """Image x per cell, on the link's scale."""
        return self._model_and_image(*self._split_coefficients(coefficients))[1]

    def with_applied_unknowns(self, model: ForwardModel, coefficients: Float[Array, " n"]) -> ForwardModel:
        """Copy of `model` changed by the estimated unknowns, such as contact impedances or electrode positions."""
        for unknown, unknown_values in zip(self.unknowns, self.values(coefficients), strict=True):
            model, _ = unknown.apply(model, self.reference, unknown_values)
        return model

    def values(self, coefficients: Float[Array, " n"]) -> tuple[Float[Array, " k"], ...]:
        """Estimated values of every unknown, in the form that `AbstractUnknown.apply` takes."""
        return self._split_coefficients(coefficients)[1]

    def voltages(self, coefficients: Float[Array, " n"]) -> Float[Array, " r"]:
        """Predicted voltages of the independent channels, volts."""
        return self._predict_voltages(*self._split_coefficients(coefficients))

    def residual(self, coefficients: Float[Array, " n"]) -> Float[Array, " r"]:
        """Residual w (v(σ) - ŷ), whose covariance is `data.covariance`."""
        return self.data.weight * (self.voltages(coefficients) - self.data.voltages)

    def linearise(self, coefficients: Float[Array, " n"]) -> tuple[Float[Array, " r"], Float[Array, "r n"]]:
        """Residual (r,) of the data, and the Jacobian (r, n) of the residual with respect to the coefficients."""
        image_coefficients, unknown_values = self._split_coefficients(coefficients)
        model, estimate = self._model_and_image(image_coefficients, unknown_values)
        conductivity = self.link.conductivity(estimate)
        if namespace(model, conductivity, self.basis) is np:
            fields, impedance = evaluate(model, fields_and_impedance_of, conductivity)
            voltages, link_slope = channel_voltages(model.protocol, impedance), self.link.slope(estimate)
            blocks_of_jacobian = jacobian_blocks(model.mesh, model.protocol, fields)
            jacobian = self.basis.restrict_blocks(
                (cells, jacobian_block * link_slope[cells]) for cells, jacobian_block in blocks_of_jacobian
            )
        else:
            voltages, jacobian = evaluate(model, voltages_and_jacobian_of, conductivity)
            jacobian = self.basis.restrict(jacobian * self.link.slope(estimate))
        jacobian_columns = [jacobian]
        if self.unknowns:
            jacobian_of_unknowns = jax.jacfwd(
                lambda unknown_values: self._predict_voltages(image_coefficients, unknown_values)
            )(unknown_values)
            jacobian_columns += [
                jacobian_block * unknown.deviation
                for jacobian_block, unknown in zip(jacobian_of_unknowns, self.unknowns, strict=True)
            ]
        data_weight, xp = self.data.weight, namespace(voltages, jacobian)
        # A factorisation may succeed although some conductivities are negative; NaN causes a descent to reject the
        # point.
        residual = xp.where((conductivity > 0).all(), data_weight * (voltages - self.data.voltages), xp.nan)
        jacobian = xp.concatenate(jacobian_columns, axis=1) if self.unknowns else jacobian
        if xp is np:
            jacobian *= data_weight[:, None]  # in place, to save the memory of a copy
            return residual, jacobian
        return residual, data_weight[:, None] * jacobian

    def cost(self, coefficients: Float[Array, " n"]) -> Float[Array, ""]:
        """Objective ½ rᵀ G r + penalty(c)."""
        residual = self.residual(coefficients)
        return 0.5 * residual @ self.data.precision @ residual + self.penalty.cost(coefficients)

    def quadratic_model(self, coefficients: Float[Array, " n"]) -> QuadraticModel:
        """Objective at the coefficients, and the function that computes a step, for `jeit_solvers.Descent`."""
        residual, jacobian = self.linearise(coefficients)
        return self.penalty.model(residual, jacobian, coefficients, self.data)

    def _split_coefficients(self, coefficients):
        """Split the coefficients into those of the image and the values of every unknown."""
        unknown_values, first_index = [], self.basis.num_coefficients
        for unknown in self.unknowns:
            unknown_values.append(unknown.deviation * coefficients[first_index : first_index + unknown.size])
            first_index += unknown.size
        return coefficients[: self.basis.num_coefficients], tuple(unknown_values)

    def _model_and_image(self, image_coefficients, unknown_values) -> tuple[ForwardModel, Float[Array, " m"]]:
        """Forward model with the estimated electrodes, contacts and scale; and the image x, such as log σ, from which
        the `link` computes conductivities."""
        model, estimate = self.model, self.reference + self.basis.expand(image_coefficients)
        for unknown, unknown_value in zip(self.unknowns, unknown_values, strict=True):
            model, estimate = unknown.apply(model, estimate, unknown_value)
        return model, estimate

    def _predict_voltages(self, image_coefficients, unknown_values):
        model, estimate = self._model_and_image(image_coefficients, unknown_values)
        return evaluate(model, voltages_of, self.link.conductivity(estimate))


@eqx.filter_jit
def as_solution(coefficients: Float[Array, " n"], inversion: Inversion, box: Any = None) -> Float[Array, " n"]:
    """Return `coefficients` (n,), the result of a solver, with unchanged values but with the derivatives of the exact
    minimum. Derivatives are with respect to all fields of the inversion and, if there are bounds, the lower and upper
    bounds `box`, (n,) each."""
    if box is None:
        return as_minimum(coefficients, (inversion, None, None), _free_gradient, _preconditioner)
    gradient = jax.grad(inversion.cost)(coefficients)
    # -1 for a coefficient at the lower bound, 1 at the upper bound, 0 for a free coefficient.
    bound_tolerances = [_BOUND_TOLERANCE * jnp.maximum(1, jnp.abs(bound_values)) for bound_values in box]
    active_bounds = 1 * ((coefficients >= box[1] - bound_tolerances[1]) & (gradient < 0)) - (
        (coefficients <= box[0] + bound_tolerances[0]) & (gradient > 0)
    )
    stationary_point = as_minimum(
        jnp.where(active_bounds == 0, coefficients, 0), (inversion, box, active_bounds), _free_gradient, _preconditioner
    )
    return _replace_bound_components(stationary_point, box, active_bounds)


def _replace_bound_components(stationary_point, coefficient_bounds, active_bounds):
    """Coefficients that equal `stationary_point` where they are free and their bounds elsewhere."""
    return (
        stationary_point
        if coefficient_bounds is None
        else jnp.where(
            active_bounds < 0,
            coefficient_bounds[0],
            jnp.where(active_bounds > 0, coefficient_bounds[1], stationary_point),
        )
    )


def _free_gradient(stationary_point, problem):
    """Gradient of the objective with respect to the free coefficients. For the other coefficients the function returns
    `stationary_point`, so at a zero of this function their entries in it are zero; `_replace_bound_components` replaces
    them by the bounds."""
    inversion, coefficient_bounds, active_bounds = problem
    gradient = jax.grad(inversion.cost)(_replace_bound_components(stationary_point, coefficient_bounds, active_bounds))
    return gradient if coefficient_bounds is None else jnp.where(active_bounds == 0, gradient, stationary_point)


def _preconditioner(stationary_point, problem):
    """Function that multiplies a vector by the inverse of the Gauss-Newton matrix JᵀGJ + P of the free coefficients,
    where P is the penalty's Hessian. Woodbury's identity gives P⁻¹ - P⁻¹Jᵀ(JP⁻¹Jᵀ + G⁻¹)⁻¹JP⁻¹."""
    inversion, coefficient_bounds, active_bounds = problem
    coefficients = _replace_bound_components(stationary_point, coefficient_bounds, active_bounds)
    is_free_coefficient = jnp.ones(stationary_point.shape, bool) if coefficient_bounds is None else active_bounds == 0
    jacobian = jnp.where(is_free_coefficient, inversion.linearise(coefficients)[1], 0)
    covariance_product = inversion.penalty.inverse_hessian(coefficients, is_free_coefficient, jacobian.T)
    data_covariance = jacobian @ covariance_product
    inverse_data_covariance = symmetric_inverse((data_covariance + data_covariance.T) / 2 + inversion.data.covariance)

    def apply_preconditioner(gradient_vector):
        preconditioned_image = inversion.penalty.inverse_hessian(
            coefficients, is_free_coefficient, jnp.where(is_free_coefficient, gradient_vector, 0)[:, None]
        )[:, 0]
        return jnp.where(
            is_free_coefficient,
            preconditioned_image - covariance_product @ (inverse_data_covariance @ (jacobian @ preconditioned_image)),
            gradient_vector,
        )

    return apply_preconditioner
