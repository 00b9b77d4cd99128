"""Changes of electrodes on the edge of a sheet between a reference and a frame: displacements and changes of contact
impedance, estimated from the voltage difference together with the change of conductivity.

To first order the difference, divided by the noise of its channels, is

    d = J x + B t + c v + e,

where x is the change of conductivity, t are displacements of the electrodes along the directions in which they can move
and changes of the logarithms of their contact impedances, c is a factor common to all voltages v of the reference, and
e are errors. All are Gaussian: x with the prior of images, t with the standard deviation of electrode positions, e with
a part that breaks reciprocity, as noise does, and a part that does not, as errors of the model do. The standard
deviations of all but c maximise the evidence p(d). Electrodes are taken to have changed if the evidence with t exceeds
that without t by far, and if t displaces many electrodes and explains much of the difference. The change of the
voltages is then computed from t without the linear approximation, and t is corrected for what the approximation missed.

Displacements of a few electrodes cannot be distinguished from small bodies beside these electrodes. A change of a
single electrode can: its displacement, or the change of its contact impedance, alone explains nearly all of the
difference, which a body does not.

Soleimani, Gómez-Laberge and Adler, Physiological Measurement 27 (2006) S103, on electrode movement in difference
imaging; Gómez-Laberge and Adler, Physiological Measurement 29 (2008) S89.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from jeit.arguments import percent
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.forward.changes import PlacementSensitivity, shift_electrodes
from jeit.forward.model import select_channels
from jeit.imaging.calibration import keep_last_result
from jeit.inverse.linearisation import Linearisation
from jeit.inverse.placement import Uncertainty
from jeit.inverse.prior.matern import MEASURED_DATA_PRIOR, PRIORS
from jeit.inverse.prior.priors import AbstractPrior
from jeit_solvers.engines import as_array, on_host

# Minimum rise of the logarithm of the evidence, or of its ratio to the number of independent channels if that is less;
# maximum share of the difference that is left; minimum effective number of displaced electrodes, at most a quarter of
# all. In simulated disks, rectangles and polygons whose electrodes moved by 0.3 to 1°, with weak bodies or none, these
# were 41 to 1,000 (with 8 electrodes 4 to 30), 0 to 0.7, and 3 to 17. With electrodes at rest, the rise exceeded 30
# only for bodies smaller than an electrode beside it, with a number of at most 2.7, and was 6 for patches along the
# wall of a tank with 8 electrodes; in measured tanks it was 8 at most.
(
    _MIN_LOG_EVIDENCE_INCREASE,
    _MIN_LOG_EVIDENCE_INCREASE_PER_CHANNEL,
    _MAX_UNEXPLAINED_DIFFERENCE_SHARE,
    _MIN_EFFECTIVE_ELECTRODES,
) = 30.0, 0.4, 0.95, 3.0
# Maximum share of the difference that is left by a change of a single electrode, and maximum size of this change in
# standard deviations. In simulated disks, displacements by 0.3 to 4° left 0.03 to 0.2 in the linear approximation, and
# bodies 0.19 or more, also those smaller than the electrode beside them.
_MAX_UNEXPLAINED_SINGLE_CHANGE_SHARE, _MAX_SINGLE_CHANGE_SIZE = 0.15, 3.0
# Relative error of the voltage change that is computed from a change of a single electrode.
_RELATIVE_SINGLE_CHANGE_ERROR = 0.1
# A change is searched for if plausible displacements of the electrodes alone explain this share of the difference, with
# errors of `_ASSUMED_VOLTAGE_ERROR` of the difference. The share was 0.1 to 0.7 for electrodes at rest, and 0.87 to 1
# after movements by 0.3° or more.
_MIN_SUSPICIOUS_EXPLAINED_SHARE, _ASSUMED_VOLTAGE_ERROR = 0.6, 0.3
# Standard deviation of the logarithms of contact impedances, and largest common factor, in units of the difference.
_LOG_CONTACT_DEVIATION, _MAX_COMMON_VOLTAGE_FACTOR = 1.0, 100.0
# Initial logarithms of the standard deviations, of conductivity, of errors that break reciprocity and of those that do
# not, relative to the difference, and of changes of electrodes; width of the prior about the first three.
_INITIAL_LOG_DEVIATIONS, _LOG_DEVIATIONS_PRIOR_WIDTH = np.array([-0.3, -3.0, -3.0, -2.0]), 3.0
# Eigenvalues below this share of the largest one belong to errors alone.
_EIGENVALUE_TOLERANCE = 1e-10
# Maximum number of steps by which the change of the voltages is computed without the linear approximation, and shares
# of a step that are tried until less of the difference remains: contact impedances may have changed by factors.
_MAX_CORRECTION_STEPS, _STEP_FRACTIONS = 8, (1.0, 0.5, 0.25, 0.125)
# Factor by which contact impedances have usually changed, above which a doubt states it.
_MIN_STATED_CONTACT_FACTOR = 1.1
# Maximum number of frames of a series in which a change of the electrodes is searched for.
_MAX_SEARCHED_FRAMES = 5


class ElectrodeChange(NamedTuple):
    """Change of the electrodes between a reference and a frame, estimated by `ElectrodeChanges.find`.

    **Fields**: `shift` (L, a): displacements along the a directions in which each electrode can move, metres;
    `contact_factor` (L,): factors by which the contact impedances have changed, 1 where voltages are not measured on
    driven electrodes; `voltages` (M,): change of the voltages due to the change of the electrodes, volts; `rest`: root
    mean square of the remaining difference, as a share of the difference.
    """

    shift: Float[np.ndarray, "L a"]
    contact_factor: Float[np.ndarray, " L"]
    voltages: Float[np.ndarray, " M"]
    rest: float

    @property
    def relative_error(self) -> float:
        """Relative error of the `voltages`, which is added to the noise of the difference. It is zero unless a single
        electrode has changed: displacements of many electrodes adapt to the errors."""
        is_single_change = np.count_nonzero(self.shift) + np.count_nonzero(self.contact_factor != 1) == 1
        return _RELATIVE_SINGLE_CHANGE_ERROR if is_single_change else 0.0

    @property
    def description(self) -> str:
        """Clause that states the change of the electrodes, such as "electrodes had moved since the reference, by …"."""
        shifts_mm = 1e3 * np.linalg.norm(self.shift, axis=1)
        electrode = int(np.argmax(shifts_mm))
        log_factors = np.log(self.contact_factor)
        contact, rms_factor = int(np.argmax(np.abs(log_factors))), float(np.exp(np.sqrt(np.mean(log_factors**2))))
        if np.count_nonzero(shifts_mm) + np.count_nonzero(log_factors) > 1:
            contact_text = (
                ""
                if rms_factor < _MIN_STATED_CONTACT_FACTOR
                else f", and contact impedances had changed by a factor of about {rms_factor:.2g} (of electrode "
                f"{contact + 1}, {self.contact_factor[contact]:.2g})"
            )
            return (
                f"electrodes had moved since the reference, by about {np.sqrt(np.mean(shifts_mm**2)):.2g} mm (root "
                f"mean square; electrode {electrode + 1} by about {shifts_mm[electrode]:.2g} mm){contact_text}, or as "
                "if a layer along the wall had changed"
            )
        if shifts_mm.any():
            return f"electrode {electrode + 1} had moved by about {shifts_mm[electrode]:.2g} mm since the reference"
        return (
            f"the contact impedance of electrode {contact + 1} had changed by a factor of about "
            f"{self.contact_factor[contact]:.2g} since the reference"
        )

    @property
    def doubt(self) -> str:
        """A sentence about the change of the electrodes, its effect on the image, and what to do."""
        return (
            f"the voltages have changed as if {self.description}. The image shows the rest of the difference, "
            f"{percent(self.rest)} of it (as_is=True, --as-is: all of it). Measure a new reference."
        )


class ElectrodeChanges:
    """Estimates changes of the electrodes from voltage differences.

    `model`, `background`: the model of the reference and its conductivity, S/m (2-D: S); `noise` (M,): errors of the
    channels relative to each other; `mask` (M,): True for the channels to use; `deviation`: standard deviation of
    electrode positions, metres; `prior`: the prior of the change of conductivity.
    """

    def __init__(
        self,
        model: ForwardModel,
        background: float,
        noise: Float[np.ndarray, " M"],
        mask: Bool[np.ndarray, " M"],
        deviation: float,
        prior: AbstractPrior,
    ):
        self.model, self.background, self.mask, self.prior = model, background, mask, prior
        self._reference_voltages, voltage_derivatives = _voltages_and_derivatives(model, background)
        num_contacts = _num_contacts(model)
        self._num_shifts = voltage_derivatives.shape[1] - num_contacts
        self._deviations = np.repeat([deviation, _LOG_CONTACT_DEVIATION], [self._num_shifts, num_contacts])
        self._channel_noise, self._weights = noise, mask / noise
        self._derivatives = voltage_derivatives * self._deviations

    @classmethod
    def on_edge(
        cls, model: ForwardModel, background: float, noise: Float[np.ndarray, " M"], mask: Bool[np.ndarray, " M"]
    ) -> ElectrodeChanges | None:
        """Estimator for electrodes on the edge of a sheet; None for other electrodes, which move in two directions and
        thereby explain most of what bodies do. How far electrodes move does not depend on how well their positions in
        the reference are known."""
        if not isinstance(model.electrodes, BoundaryElectrodes) or model.mesh.dimension != 2:
            return None
        prior = PRIORS[MEASURED_DATA_PRIOR](float(np.ptp(np.asarray(model.mesh.points), axis=0).max()))
        return cls(model, background, noise, mask, Uncertainty().position_on(model.mesh), prior)

    def find(
        self, difference: Float[np.ndarray, " M"], estimator: Float[np.ndarray, "p M"] | None = None
    ) -> ElectrodeChange | None:
        """Estimate the change of the electrodes from a voltage `difference` (M,), volts; None if they have not
        changed, or if they explain little of the difference. `estimator`: that of the difference, if it is known."""
        estimator = self.estimator(difference) if estimator is None else estimator
        if estimator is None:
            return None
        linear_estimate = estimator @ difference
        linear_change = self._derivatives @ linear_estimate
        linear_remaining_share = float(
            self._weighted_norm(difference - linear_change) / self._weighted_norm(difference)
        )
        scaled_changes, voltage_change = np.zeros(len(estimator)), np.zeros(len(difference))
        remaining_share, max_remaining_share = 1.0, _max_remaining_share(estimator)
        for _ in range(_MAX_CORRECTION_STEPS):
            correction = estimator @ (difference - voltage_change + self._derivatives @ scaled_changes) - scaled_changes
            for step_fraction in _STEP_FRACTIONS:
                try:
                    trial_change = self._change_of_voltages(scaled_changes + step_fraction * correction)
                except ValueError:  # electrodes would overlap or leave the body
                    continue
                trial_share = float(self._weighted_norm(difference - trial_change) / self._weighted_norm(difference))
                if trial_share < remaining_share:
                    scaled_changes, voltage_change, remaining_share = (
                        scaled_changes + step_fraction * correction,
                        trial_change,
                        trial_share,
                    )
                    break
            else:
                break
        # On a coarse mesh, voltages jump where an electrode passes a node, and the linear approximation is better.
        if linear_remaining_share < remaining_share:
            scaled_changes, voltage_change, remaining_share = linear_estimate, linear_change, linear_remaining_share
        if remaining_share >= max_remaining_share:
            return None
        contact_factors = np.exp(self._log_contact_factors(scaled_changes))
        return ElectrodeChange(self._electrode_shifts(scaled_changes), contact_factors, voltage_change, remaining_share)

    def voltages(
        self, differences: Float[np.ndarray, "N M"], estimator: Float[np.ndarray, "p M"]
    ) -> Float[np.ndarray, "N M"]:
        """Changes of the voltages (N, M) due to changes of the electrodes, in the linear approximation with an
        `estimator`; zero for differences (N, M) of which they explain little. All are in volts."""
        scaled_changes = differences @ estimator.T
        voltage_changes = scaled_changes @ self._derivatives.T
        explains_difference = self._weighted_norm(differences - voltage_changes) < _max_remaining_share(
            estimator
        ) * self._weighted_norm(differences)
        # If n electrodes are displaced equally, the square of the sum of squares is n times the sum of fourth powers.
        squared_shifts = (scaled_changes**2)[:, : self._num_shifts]
        num_electrodes = self.model.electrodes.num_electrodes
        squares_per_electrode = squared_shifts.reshape(len(squared_shifts), num_electrodes, -1).sum(axis=2)
        num_effective_electrodes = squares_per_electrode.sum(axis=1) ** 2 / np.maximum(
            (squares_per_electrode**2).sum(axis=1), np.finfo(float).tiny
        )
        affects_several_electrodes = _is_single_change(estimator) | (
            num_effective_electrodes > min(_MIN_EFFECTIVE_ELECTRODES, num_electrodes / 4)
        )
        is_electrode_change = self.are_suspicious(differences) & explains_difference & affects_several_electrodes
        return np.where(is_electrode_change[:, None], voltage_changes, 0.0)

    def estimator_for(self, differences: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "p M"] | None:
        """Return the `estimator` for the largest of several differences (N, M) that shows a change of the electrodes;
        changes of many electrodes take precedence over a change of a single one. Returns None if none of the
        `_MAX_SEARCHED_FRAMES` largest suspicious differences shows a change."""
        suspicious_frames = np.flatnonzero(self.are_suspicious(differences))
        largest_frames = suspicious_frames[
            np.argsort(-self._weighted_norm(differences[suspicious_frames]), kind="stable")[:_MAX_SEARCHED_FRAMES]
        ]
        single_change_estimator = None
        for frame_index in largest_frames:
            if (estimator := self.estimator(differences[frame_index])) is not None:
                if not _is_single_change(estimator):
                    return estimator
                single_change_estimator = estimator if single_change_estimator is None else single_change_estimator
        return single_change_estimator

    def estimator(self, difference: Float[np.ndarray, " M"]) -> Float[np.ndarray, "p M"] | None:
        """Matrix (p, M) that estimates changes of the electrodes, in units of their standard deviations, from a
        difference in volts. Its standard deviations are those that best explain the `difference` (M,). Returns None if
        the evidence does not favour changes of the electrodes, or if they explain little of the difference. For a
        change of a single electrode, only one row of the matrix is nonzero."""
        if not self.are_suspicious(difference[None])[0]:
            return None
        noise, mask = as_array(self._channel_noise), as_array(self.mask)
        linearisation = Linearisation.create(self.model, self.background, prior=self.prior, noise=noise, mask=mask)
        estimator = _WhitenedProblem(linearisation, difference, self._derivatives, self._reference_voltages).estimator()
        if estimator is None or not self.voltages(difference[None], estimator).any():
            return self._single_electrode_estimator(difference)
        return estimator

    def _single_electrode_estimator(self, difference: Float[np.ndarray, " M"]) -> Float[np.ndarray, "p M"] | None:
        """Return the `estimator` for a change of the one electrode that explains most of the difference (M,); None if
        this change leaves too much of the difference unexplained, or if it is implausibly large."""
        derivatives, weighted_difference = (
            self._without_common_factor(self._derivatives.T),
            self._without_common_factor(difference[None])[0],
        )
        squared_norms, inner_products = np.sum(derivatives**2, axis=1), derivatives @ weighted_difference
        explained_squares = inner_products**2 / np.maximum(squared_norms, np.finfo(float).tiny)
        best_row = int(np.argmax(explained_squares))
        # The linear approximation leaves up to twice as much unexplained as the model of the displaced electrode.
        explains_enough = weighted_difference @ weighted_difference - explained_squares[best_row] < (
            2 * _MAX_UNEXPLAINED_SINGLE_CHANGE_SHARE
        ) ** 2 * (weighted_difference @ weighted_difference)
        if not explains_enough or abs(inner_products[best_row]) > _MAX_SINGLE_CHANGE_SIZE * squared_norms[best_row]:
            return None
        estimator = np.zeros_like(derivatives)
        estimator[best_row] = derivatives[best_row] * self._weights / squared_norms[best_row]
        return estimator

    def are_suspicious(self, differences: Float[np.ndarray, "N M"]) -> Bool[np.ndarray, " N"]:
        """Whether plausible changes of the electrodes, together with a factor common to all voltages, explain so much
        of the differences (N, M) that changes must be searched for."""
        (squared_norms, orthogonal_changes), weighted_differences = (
            self._orthogonal_voltage_changes,
            self._without_common_factor(differences),
        )
        difference_norms = np.linalg.norm(weighted_differences, axis=1)
        assumed_errors = _ASSUMED_VOLTAGE_ERROR * difference_norms / np.sqrt(np.count_nonzero(self.mask))
        damped_coefficients = (weighted_differences @ orthogonal_changes.T) / (
            squared_norms + np.where(difference_norms > 0, assumed_errors, 1)[:, None] ** 2
        )
        explained_norms = np.linalg.norm(damped_coefficients @ orthogonal_changes, axis=1)
        return explained_norms > _MIN_SUSPICIOUS_EXPLAINED_SHARE * difference_norms

    @functools.cached_property
    def _orthogonal_voltage_changes(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p M"]]:
        """Orthogonal combinations (p, M) of the changes of the voltages due to plausible changes of the electrodes,
        and the squares (p,) of their norms."""
        derivatives = self._without_common_factor(self._derivatives.T)
        squared_norms, eigenvectors = np.linalg.eigh(derivatives @ derivatives.T)
        return np.maximum(squared_norms, 0), eigenvectors.T @ derivatives

    def _change_of_voltages(self, scaled_changes: Float[np.ndarray, " p"]) -> Float[np.ndarray, " M"]:
        """Change of the voltages (M,) due to changes of the electrodes. Raises `ValueError` if they would overlap or
        leave the body."""
        described_electrodes: Any = self.model.electrodes
        electrode_shifts = self._electrode_shifts(scaled_changes)
        electrodes = shift_electrodes(
            described_electrodes, np.asarray(described_electrodes.directions(self.model.mesh)), electrode_shifts
        )
        contact_impedance = np.asarray(described_electrodes.contact_impedance) * np.exp(
            self._log_contact_factors(scaled_changes)
        )
        electrodes = electrodes.with_contact_impedance(contact_impedance)
        changed_model = self.model.with_electrodes(electrodes)
        return np.where(self.mask, np.asarray(changed_model.voltages(self.background)) - self._reference_voltages, 0.0)

    def _electrode_shifts(self, scaled_changes: Float[np.ndarray, " p"]) -> Float[np.ndarray, "L a"]:
        return (self._deviations * scaled_changes)[: self._num_shifts].reshape(self.model.electrodes.num_electrodes, -1)

    def _log_contact_factors(self, scaled_changes: Float[np.ndarray, " p"]) -> Float[np.ndarray, " L"]:
        """Changes of the logarithms of the contact impedances."""
        log_factors = (self._deviations * scaled_changes)[self._num_shifts :]
        return log_factors if log_factors.size else np.zeros(self.model.electrodes.num_electrodes)

    def _without_common_factor(self, voltages: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N M"]:
        """Voltages divided by the noise of their channels, without the part that is a factor common to all."""
        weighted_voltages, reference = voltages * self._weights, self._reference_voltages * self._weights
        return weighted_voltages - np.outer(weighted_voltages @ reference, reference) / (reference @ reference)

    def _weighted_norm(self, voltages: Float[np.ndarray, "*N M"]) -> Float[np.ndarray, "*N"]:
        """Norm of voltages that are divided by the noise of their channels, without the part that is a factor common
        to all."""
        return np.linalg.norm(self._without_common_factor(np.atleast_2d(voltages)), axis=-1).reshape(
            voltages.shape[:-1]
        )


class _WhitenedProblem:
    """Voltage difference, divided by the noise of its channels, in the eigenbasis of JΓJᵀ. In this basis all
    covariances are diagonal except those of the electrodes and of the common factor."""

    def __init__(self, linearisation: Linearisation, difference, derivatives, reference):
        spectrum: Any = linearisation.spectrum
        self._used_channels, self._num_channels = linearisation.channels, len(difference)
        self._root_weight = np.asarray(linearisation.root_weight)
        whitened_data, *columns = (
            self._root_weight * voltages[self._used_channels] for voltages in (difference, reference, *derivatives.T)
        )
        eigenvalues = np.asarray(spectrum.eigenvalues)
        is_nonzero_eigenvalue = eigenvalues > _EIGENVALUE_TOLERANCE * eigenvalues.max()
        self._basis = np.asarray(spectrum.basis)[:, is_nonzero_eigenvalue]
        self._data_rms = float(np.sqrt(np.mean(whitened_data**2)))
        self._difference = self._basis.T @ whitened_data
        self._null_dimension = len(whitened_data) - len(self._difference)
        self._null_sum = max(float(whitened_data @ whitened_data - self._difference @ self._difference), 0.0)
        self._eigenvalues = eigenvalues[is_nonzero_eigenvalue] * (len(whitened_data) / eigenvalues.sum())
        reference_part, *derivatives = (self._basis.T @ column for column in columns)
        self._common_factor_column = reference_part * (
            _MAX_COMMON_VOLTAGE_FACTOR * self._data_rms * np.sqrt(len(whitened_data)) / np.linalg.norm(reference_part)
        )
        self._derivatives = np.stack(derivatives, axis=1)

    def estimator(self) -> Float[np.ndarray, "p M"] | None:
        """Return `ElectrodeChanges.estimator`; None if the evidence does not favour changes of the electrodes."""
        options = {"maxiter": 400, "xatol": 0.02, "fatol": 0.05}
        optimum_without_change, optimum = (
            scipy.optimize.minimize(
                self._negative_log_posterior, _INITIAL_LOG_DEVIATIONS[:number], method="Nelder-Mead", options=options
            )
            for number in (3, 4)
        )
        if optimum_without_change.fun - optimum.fun < min(
            _MIN_LOG_EVIDENCE_INCREASE, _MIN_LOG_EVIDENCE_INCREASE_PER_CHANNEL * len(self._difference)
        ):
            return None
        variances, columns, inner_matrix = self._covariance_factors(optimum.x)
        estimator_rows = (
            np.exp(optimum.x[3]) * np.linalg.solve(inner_matrix, (columns / variances[:, None]).T)[:-1] @ self._basis.T
        )
        estimator_matrix = np.zeros((len(estimator_rows), self._num_channels))
        estimator_matrix[:, self._used_channels] = estimator_rows * self._root_weight
        return estimator_matrix

    def _covariance_factors(self, log_deviations):
        """Variances (r,), columns (r, q) and the inner matrix (q, q) of the covariance D + C Cᵀ of the data, whose
        inverse is D⁻¹ - D⁻¹ C (I + Cᵀ D⁻¹ C)⁻¹ Cᵀ D⁻¹."""
        conductivity_variance, noise_variance, error_variance = np.exp(2 * log_deviations[:3]) * self._data_rms**2
        variances = conductivity_variance * self._eigenvalues + noise_variance + error_variance
        columns = self._common_factor_column[:, None]
        if len(log_deviations) > 3:
            columns = np.column_stack([np.exp(log_deviations[3]) * self._derivatives, self._common_factor_column])
        return variances, columns, np.eye(columns.shape[1]) + (columns.T / variances) @ columns

    def _negative_log_posterior(self, log_deviations) -> float:
        """Negative logarithm of the evidence and of the prior of the logarithms of the standard deviations."""
        variances, columns, inner_matrix = self._covariance_factors(log_deviations)
        projection = (columns.T / variances) @ self._difference
        chi_square = self._difference**2 @ (1 / variances) - projection @ np.linalg.solve(inner_matrix, projection)
        noise_variance = np.exp(2 * log_deviations[1]) * self._data_rms**2
        chi_square += self._null_sum / noise_variance
        log_determinant = (
            np.log(variances).sum() + np.linalg.slogdet(inner_matrix)[1] + self._null_dimension * np.log(noise_variance)
        )
        log_departures = (log_deviations[:3] - _INITIAL_LOG_DEVIATIONS[:3]) / _LOG_DEVIATIONS_PRIOR_WIDTH
        # Excess of the logarithm of the standard deviation of changes over the stated value.
        excess_log_deviation = 2 * max(log_deviations[3], 0) if len(log_deviations) > 3 else 0.0
        return 0.5 * (chi_square + log_determinant + log_departures @ log_departures + excess_log_deviation**2)


@keep_last_result
def _voltages_and_derivatives(
    model: ForwardModel, background: float
) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, "M p"]]:
    """Voltages (M,) of a model, and their derivatives with respect to displacements, volts per metre, and, if voltages
    are measured on driven electrodes, to the logarithms of the contact impedances, volts."""
    fields, impedance = map(np.asarray, on_host(model.fields(background)))
    protocol, electrodes = on_host(model.protocol), model.electrodes
    impedance_changes = PlacementSensitivity(model.mesh, electrodes)(fields, impedance)  # pyright: ignore[reportArgumentType]
    impedance_changes = impedance_changes[: len(impedance_changes) - electrodes.num_electrodes + _num_contacts(model)]
    voltages, *derivatives = (
        np.asarray(select_channels(protocol, impedance_change)) for impedance_change in (impedance, *impedance_changes)
    )
    return voltages, np.stack(derivatives, axis=1)


def _is_single_change(estimator: Float[np.ndarray, "p M"]) -> bool:
    """Whether an estimator describes the change of a single electrode."""
    return np.count_nonzero(estimator.any(axis=1)) == 1


def _max_remaining_share(estimator: Float[np.ndarray, "p M"]) -> float:
    """Return the maximum share of a difference that changes of the electrodes may leave unexplained."""
    return _MAX_UNEXPLAINED_SINGLE_CHANGE_SHARE if _is_single_change(estimator) else _MAX_UNEXPLAINED_DIFFERENCE_SHARE


def _num_contacts(model: ForwardModel) -> int:
    """Return the number of contact impedances that affect the voltages: zero unless voltages are measured on driven
    electrodes."""
    return model.electrodes.num_electrodes if model.protocol.channels_on_driven_electrodes().any() else 0
