"""Estimation of electrode positions and contact impedances from a reference frame.

Electrodes are rarely exactly where a description says, and their contact impedances differ. Positions and contact
impedances are estimated from a frame y of the homogeneous body. With shifts t of the electrodes along the directions in
which they can move, contact impedances z = z₀ e^ζ and a conductivity σ, the estimate minimises

    ½ ‖(v(σ, t, z) - y) / κn‖² + ½ ‖t / s‖² + ½ ζᵀ Γ⁻¹ ζ,

where v are the predicted voltages, n is the `relative_noise` of the channels, s the prior standard deviation of the
positions, and Γ the prior covariance of the logarithms ζ. The errors of these logarithms have a common part. The factor
κ is estimated from the residual. Derivatives require no further solution of the forward problem: at fixed fields only
the energy of electrode l depends on t_l (`jeit.forward.changes`).

Kolehmainen, Vauhkonen, Karjalainen and Kaipio, Physiological Measurement 18 (1997) 289, on errors of electrode
positions; Vilhunen, Kaipio, Vauhkonen, Savolainen and Vauhkonen, Measurement Science and Technology 13 (2002) 1848, on
contact impedances; Darde, Hyvönen, Seppänen and Staboulis, SIAM Journal on Imaging Sciences 6 (2013) 176, on estimating
both together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from jeit.arguments import check_has_values, describe, is_number
from jeit.electrodes.electrodes import AbstractMovableElectrodes
from jeit.forward import ForwardModel
from jeit.forward.changes import PlacementSensitivity, shift_electrodes
from jeit.forward.model import select_channels
from jeit.inverse.channels import IndependentChannels, relative_noise
from jeit.inverse.nonlinear.problem import check_frame
from jeit.mesh import Mesh
from jeit_solvers import Descent, QuadraticModel, ridge_model
from jeit_solvers.engines import RecentResultsCache, as_array, on_host

# Prior standard deviations: of the logarithm of each contact impedance, of the common part of these logarithms, and of
# the logarithm of the conductivity about the value that best fits the described model.
_INDIVIDUAL_CONTACT_DEVIATION, _COMMON_CONTACT_DEVIATION, _CONDUCTIVITY_DEVIATION = 1.0, 4.0, 2.0
# Maximum numbers of steps of the two fits, before and after κ is estimated, and the tolerance of their cost, by
# dimension of the mesh. A step in a solid takes a second.
_MAX_STEPS, _RELATIVE_TOLERANCE = {2: (40, 40), 3: (5, 3)}, {2: 1e-4, 3: 3e-3}
# Default standard deviation of electrode positions, as a share of the width of the body: 2° of a disk.
_RELATIVE_POSITION_DEVIATION = 0.0175
# Minimum of κ, the noise in units of `relative_noise`: 0.1 means 0.1 % of a voltage.
_MIN_RELATIVE_NOISE = 0.1


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the description of a sensor, as standard deviations. All but `position` are relative: 0.1 is 10 %.

    **Fields**: `position`: standard deviation of electrode positions, metres, in every direction in which electrodes
    can move; default: 0.0175 of the width of the body, which is 2° on a disk. `drift`: standard deviation of the change
    of the logarithm of each contact impedance between the reference and the frame. `size`: standard deviation of the
    lengths of the body. `other`: standard deviation of all other errors of the model, as a share of the difference of
    the two frames; if the misfit of the reference is larger, the misfit is used instead. Raises `ValueError` for values
    that are negative or not finite, and for `size` or `other` above 1.

    **Example:**

    ```python
    doubts = Uncertainty(position=1e-3, drift=0.05)
    ```
    """

    position: float | None = None
    drift: float = 0.1
    size: float = 0.01
    other: float = 0.02

    def __post_init__(self):
        for name, upper_limit in (("position", np.inf), ("drift", np.inf), ("size", 1.0), ("other", 1.0)):
            field_value: Any = getattr(self, name)
            is_valid = is_number(field_value) and np.isfinite(field_value) and 0 <= float(field_value) <= upper_limit
            if not (is_valid or (field_value is None and name == "position")):
                expected_value = "metres, 0 or more" if name == "position" else "a share, not per cent"
                expected_value += " from 0 to 1" if upper_limit == 1 else ""
                raise ValueError(f"{name} must be a number, {expected_value}; it is {describe(field_value)}.")

    def position_on(self, mesh: Mesh) -> float:
        """`position`, or its default on a mesh, metres."""
        if self.position is not None:
            return float(self.position)
        return _RELATIVE_POSITION_DEVIATION * float(np.ptp(np.asarray(mesh.points), axis=0).max())


class Placement(NamedTuple):
    """Estimated positions of electrodes, the result of `place_electrodes`.

    **Fields**: `model`: the model with the estimated electrodes; `conductivity`: estimated background, S/m (2-D: S);
    `shift` (L, a): displacements along the a directions in which each electrode can move, metres; `deviation` (L, a):
    posterior standard deviations of the displacements, metres; `error`: the remaining `ModelError`.

    **Example:**

    ```python
    placed = place_electrodes(model, reference, deviation=1e-3)
    placed.shift, placed.deviation
    ```
    """

    model: ForwardModel
    conductivity: float
    shift: Float[np.ndarray, "L a"]
    deviation: Float[np.ndarray, "L a"]
    error: "ModelError"


class ModelError(NamedTuple):
    """Error of the model, and thereby of predicted differences of two frames, because electrode positions and contact
    impedances are known only as well as the reference frame determines them.

    **Fields**: `factor` (p, p): F with the posterior covariance F Fᵀ of the shifts, metres, and of the logarithms of
    the contact impedances; `drift`: standard deviation of the change of the logarithm of each contact impedance between
    the reference and the frame.

    Kaipio and Somersalo, Journal of Computational and Applied Mathematics 198 (2007) 493.

    **Example:**

    ```python
    error = place_electrodes(model, reference, deviation=1e-3).error
    error.factor.shape
    ```
    """

    factor: Float[np.ndarray, "p p"]
    drift: float = Uncertainty().drift

    def voltages(self, model: ForwardModel, conductivity: ArrayLike, background: ArrayLike) -> Float[np.ndarray, "M q"]:
        """Errors (M, q) of the voltage difference v(`conductivity`) - v(`background`), volts; each column is due to one
        standard deviation of one of q independent errors.

        `conductivity` and `background` per cell, S/m (2-D: S). The covariance of the difference is the product of this
        matrix with its transpose.
        """
        electrodes: Any = model.electrodes
        placement_sensitivity, protocol = PlacementSensitivity(model.mesh, electrodes), on_host(model.protocol)

        def channel_rows(impedances):
            return np.stack([np.asarray(select_channels(protocol, impedance)) for impedance in impedances], axis=1)

        impedance_derivatives, background_derivatives = (
            placement_sensitivity(*map(np.asarray, model.fields(cell_values)))
            for cell_values in (conductivity, background)
        )
        drift_errors = self.drift * channel_rows(impedance_derivatives[-electrodes.num_electrodes :])
        return np.concatenate(
            [channel_rows(impedance_derivatives - background_derivatives) @ self.factor, drift_errors], axis=1
        )


class _LinearisedModel(NamedTuple):
    """Forward model with trial values of the electrode positions and contact impedances, with the conductivity, fields
    F, transfer impedance Z and predicted voltages (M,)."""

    model: ForwardModel
    conductivity: float
    fields: Float[np.ndarray, "n L"]
    impedance: Float[np.ndarray, "L L"]
    voltages: Float[np.ndarray, " M"]


def place_electrodes(
    model: ForwardModel,
    voltages: Float[ArrayLike, " M"],
    *,
    deviation: float,
    mask: Bool[ArrayLike, " M"] | None = None,
) -> Placement:
    """Estimate the positions and contact impedances of the electrodes of a model from a frame of the homogeneous body.

    **Arguments:**

    - `model`: the model with the electrodes at their described positions.
    - `voltages` (M,): measured voltages of the homogeneous body, volts.
    - `deviation`: standard deviation of the described positions, metres, in every direction in which an electrode can
      move; 0 if they are exact.
    - `mask` (M,): True for the channels to use.

    Raises `ValueError` for electrodes that cannot move, invalid arguments, voltages that have the opposite sign of the
    model's, and if no positions are found that explain the voltages.

    **Example:**

    ```python
    placed = place_electrodes(model, reference, deviation=1e-3)
    ```
    """
    measured_voltages, is_used_channel = check_frame(model, voltages, mask)
    check_has_values("place_electrodes", (model, measured_voltages), "the fit takes steps of NumPy", "take calibrate")
    body_width = float(np.ptp(np.asarray(model.mesh.points), axis=0).max())
    if not (is_number(deviation) and 0 <= deviation < body_width):
        raise ValueError(
            f"deviation must be a number of metres, less than the width of the body, {body_width:.3g} m; it is "
            f"{describe(deviation)}."
        )
    if not isinstance(model.electrodes, AbstractMovableElectrodes):
        raise ValueError(f"electrodes: {type(model.electrodes).__name__} have no position that can be estimated.")
    problem = _PlacementProblem(model, np.asarray(measured_voltages), is_used_channel, deviation)
    num_coefficients, noise_scale = len(problem.spread), 1.0
    coefficients: Any = np.zeros(num_coefficients)
    fitted_point, covariance = None, np.eye(num_coefficients)
    for max_steps in _MAX_STEPS[model.mesh.dimension]:
        gauss_newton_descent = Descent(
            rtol=_RELATIVE_TOLERANCE[model.mesh.dimension], damping=1e-2, history=max_steps + 1
        )
        coefficients, _ = gauss_newton_descent.at_once(problem.expand, coefficients, noise_scale, max_steps)
        fitted_point = problem.at(coefficients)
        if fitted_point is None or not np.isfinite(fitted_point.voltages).all():
            raise ValueError("voltages: no electrode positions were found that explain them.")
        noise_scale, covariance = problem.noise_and_covariance(fitted_point, noise_scale)
    assert fitted_point is not None
    covariance_factor, shape_of_shifts = problem.factor(covariance), problem.directions.shape[:2]
    num_shifts = shape_of_shifts[0] * shape_of_shifts[1]
    position_shift = (problem.spread @ coefficients)[1 : 1 + num_shifts].reshape(shape_of_shifts)
    shift_deviation = np.linalg.norm(covariance_factor[:num_shifts], axis=1).reshape(shape_of_shifts)
    return Placement(
        fitted_point.model, fitted_point.conductivity, position_shift, shift_deviation, ModelError(covariance_factor)
    )


class _PlacementProblem:
    """Voltages, and their derivatives with respect to coefficients of unit prior variance for log σ, the shifts and log
    zσ, with the conductivity σ and the contact impedances z."""

    def __init__(self, model: ForwardModel, measured: np.ndarray, used: np.ndarray, deviation: float):
        self.described_model, self.mesh, self.protocol = model, on_host(model.mesh), on_host(model.protocol)
        # A fit ends at a point that it has already computed.
        self.at, self.jacobian = RecentResultsCache(self._model_at), RecentResultsCache(self._jacobian)
        self.used = used
        self.measured = measured
        self.num_independent = len(IndependentChannels.create(self.protocol).index)
        self.noise = np.asarray(relative_noise(as_array(measured), as_array(self.used)))
        electrodes: Any = model.electrodes
        self.directions = np.asarray(electrodes.directions(self.mesh))
        num_electrodes, num_directions = self.directions.shape[:2]
        unit_voltages = np.asarray(model.voltages(1.0))[self.used]
        if not unit_voltages @ measured[self.used] > 0:
            raise ValueError("voltages: they have the opposite sign of the model's.")
        self.log_conductivity = float(np.log(unit_voltages @ unit_voltages / (unit_voltages @ measured[self.used])))
        contact_covariance = _INDIVIDUAL_CONTACT_DEVIATION**2 * np.eye(num_electrodes) + _COMMON_CONTACT_DEVIATION**2
        self.spread = np.zeros((1 + num_electrodes * (num_directions + 1),) * 2)
        self.spread[0, 0] = _CONDUCTIVITY_DEVIATION
        shift_indices = np.arange(1, 1 + num_electrodes * num_directions)
        self.spread[shift_indices, shift_indices] = deviation
        self.spread[1 + num_electrodes * num_directions :, 1 + num_electrodes * num_directions :] = np.linalg.cholesky(
            contact_covariance
        )

    def _model_at(self, coefficients: Float[np.ndarray, " p"]) -> _LinearisedModel | None:
        """Compute the model with the parameters that follow from the `coefficients`; None if electrodes would overlap
        or leave the body."""
        num_electrodes, num_directions = self.directions.shape[:2]
        physical_parameters = self.spread @ coefficients
        position_shifts, log_contact = (
            physical_parameters[1 : 1 + num_electrodes * num_directions].reshape(num_electrodes, num_directions),
            physical_parameters[1 + num_electrodes * num_directions :],
        )
        log_conductivity = self.log_conductivity + physical_parameters[0]
        described_electrodes: Any = self.described_model.electrodes
        shifted_electrodes: Any = shift_electrodes(described_electrodes, self.directions, position_shifts)
        impedance = np.asarray(described_electrodes.contact_impedance) * np.exp(log_contact - physical_parameters[0])
        try:
            model = self.described_model.with_electrodes(shifted_electrodes.with_contact_impedance(impedance))
        except ValueError:
            return None
        conductivity = float(np.exp(log_conductivity))
        fields, transfer_impedance = on_host(model.fields(conductivity))
        predicted_voltages = np.asarray(select_channels(self.protocol, transfer_impedance))
        return _LinearisedModel(model, conductivity, fields, transfer_impedance, predicted_voltages)

    def expand(self, coefficients, scale: float) -> QuadraticModel:
        """Cost at the coefficients, and the function that computes a Levenberg-Marquardt step, for a `scale` κ of the
        noise."""
        linearised_model = self.at(coefficients)
        if linearised_model is None:
            return np.inf, lambda damping: None  # pyright: ignore
        residual = self._residual(linearised_model) / scale
        objective_value = 0.5 * (residual @ residual + coefficients @ coefficients)
        data_identity: Any = np.eye(len(residual))

        def regularised_step(damping):
            weighted_jacobian = self.jacobian(linearised_model) / scale
            return ridge_model(residual, weighted_jacobian, coefficients, data_identity, data_identity)[1](damping)  # pyright: ignore

        return objective_value, regularised_step

    def noise_and_covariance(self, point: _LinearisedModel, scale: float) -> tuple[float, Float[np.ndarray, "p p"]]:
        """Noise scale κ estimated from the residual of a fit at `scale`, and the posterior covariance of the
        coefficients with this κ.

        Dependent channels count once: the number of degrees of freedom of the residual is the number of independent
        channels minus the effective number of parameters of the fit.
        """
        residual, jacobian_rows = self._residual(point), self.jacobian(point)
        num_independent = min(self.num_independent, len(residual))
        independent_data_share = num_independent / len(residual)
        # Computed from eigenvalues, the covariance stays positive definite where rounding makes the Hessian's inverse
        # indefinite.
        eigenvalues, eigenvectors = np.linalg.eigh(jacobian_rows.T @ jacobian_rows)
        eigenvalues = np.maximum(eigenvalues, 0)
        num_fitted = np.sum(eigenvalues / (eigenvalues + scale**2))
        degrees_of_freedom = max(num_independent - num_fitted, 0.3 * num_independent)
        scale = max(
            _MIN_RELATIVE_NOISE, float(np.sqrt(independent_data_share * (residual @ residual) / degrees_of_freedom))
        )
        return scale, (eigenvectors / (1 + eigenvalues / scale**2)) @ eigenvectors.T

    def factor(self, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "q q"]:
        """Factor F of the covariance F Fᵀ of the shifts, metres, and of log z, from the `covariance` of the
        coefficients."""
        parameter_root = self.spread.copy()
        parameter_root[1 + self.directions.shape[0] * self.directions.shape[1] :] -= self.spread[
            0
        ]  # log z = log zσ - log σ
        parameter_root = parameter_root[1:]
        eigenvalues, eigenvectors = np.linalg.eigh(parameter_root @ covariance @ parameter_root.T)
        return eigenvectors * np.sqrt(np.maximum(eigenvalues, 0))

    def _residual(self, point: _LinearisedModel) -> Float[np.ndarray, " u"]:
        return ((point.voltages - self.measured) / self.noise)[self.used]

    def _jacobian(self, point: _LinearisedModel) -> Float[np.ndarray, "u p"]:
        """Derivatives of the weighted voltages with respect to the coefficients."""
        electrodes: Any = point.model.electrodes
        placement_derivatives = PlacementSensitivity(self.mesh, electrodes)(point.fields, point.impedance)
        impedance_derivatives = np.concatenate(
            [-point.impedance[None], placement_derivatives]
        )  # the first column with respect to log σ at fixed zσ
        channel_rows = np.stack(
            [np.asarray(select_channels(self.protocol, impedance)) for impedance in impedance_derivatives], axis=1
        )
        return (channel_rows / self.noise[:, None])[self.used] @ self.spread
