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

If a few electrodes would be displaced, they are not distinguished from small bodies beside them. A single electrode is:
its displacement, or the change of its contact, alone explains nearly all of the difference, and a body does not.

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
    _MIN_NUM_EFFECTIVE_CHANNELS,
) = 30.0, 0.4, 0.95, 3.0
# Maximum share of the difference that is left by a change of a single electrode, and maximum size of this change in
# standard deviations. In simulated disks, displacements by 0.3 to 4° left 0.03 to 0.2 in the linear approximation, and
# bodies 0.19 or more, also those smaller than the electrode beside them.
_MAX_UNEXPLAINED_SHARE_OF_SINGLE_CHANGE, _MAX_SINGLE_CHANGE_SIZE = 0.15, 3.0
# Error of the voltages that a change of a single electrode explains, as a share of them.
_SINGLE_CHANGE_ERROR = 0.1
# A change is looked for if the electrodes alone, at plausible displacements, explain this share of the difference where
# errors are `_ASSUMED_RELATIVE_ERROR` of it. The share was 0.1 to 0.7 at rest, and 0.87 to 1 after movements by 0.3° or
# more.
_MIN_SUSPICIOUS_SHARE, _ASSUMED_RELATIVE_ERROR = 0.6, 0.3
# Standard deviation of the logarithms of contact impedances, and largest common factor, in units of the difference.
_CONTACT_DEVIATION, _MAX_COMMON_CONTACT_FACTOR = 1.0, 100.0
# Initial logarithms of the standard deviations, of conductivity, of errors that break reciprocity and of those that do
# not, relative to the difference, and of changes of electrodes; width of the prior about the first three.
_INITIAL_LOG_DEVIATIONS, _LOG_DEVIATIONS_PRIOR_WIDTH = np.array([-0.3, -3.0, -3.0, -2.0]), 3.0
# Eigenvalues below this share of the largest one belong to errors alone.
_RANK_TOLERANCE = 1e-10
# Maximum number of steps by which the change of the voltages is computed without the linear approximation, and shares
# of a step that are tried until less of the difference remains: contact impedances may have changed by factors.
_NUM_CORRECTIONS, _STEP_FRACTIONS = 8, (1.0, 0.5, 0.25, 0.125)
# Factor by which contact impedances have usually changed, above which a doubt states it.
_MIN_STATED_FACTOR = 1.1
# Number of frames of a series among which one with changed electrodes is searched.
_NUM_CANDIDATE_FRAMES = 5


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
        """Error of the `voltages`, as a share of them, that bodies in the image are held against: that of a single
        electrode. If many are displaced, their displacements adapt to errors."""
        is_single_change = np.count_nonzero(self.shift) + np.count_nonzero(self.contact_factor != 1) == 1
        return _SINGLE_CHANGE_ERROR if is_single_change else 0.0

    @property
    def description(self) -> str:
        """What seems to have changed, without a full stop: "electrodes had moved since the reference, by about …"."""
        distances = 1e3 * np.linalg.norm(self.shift, axis=1)
        electrode = int(np.argmax(distances))
        logarithm = np.log(self.contact_factor)
        contact, usual_factor = int(np.argmax(np.abs(logarithm))), float(np.exp(np.sqrt(np.mean(logarithm**2))))
        if np.count_nonzero(distances) + np.count_nonzero(logarithm) > 1:
            contacts = (
                ""
                if usual_factor < _MIN_STATED_FACTOR
                else f", and contact impedances had changed by a factor of about {usual_factor:.2g} (of electrode "
                f"{contact + 1}, {self.contact_factor[contact]:.2g})"
            )
            return (
                f"electrodes had moved since the reference, by about {np.sqrt(np.mean(distances**2)):.2g} mm (root "
                f"mean square; electrode {electrode + 1} by about {distances[electrode]:.2g} mm){contacts}, or as if a "
                "layer along the wall had changed"
            )
        if distances.any():
            return f"electrode {electrode + 1} had moved by about {distances[electrode]:.2g} mm since the reference"
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
        self._reference, derivatives = _voltages_and_derivatives(model, background)
        num_contacts = _num_contacts(model)
        self._num_shifts = derivatives.shape[1] - num_contacts
        self._spread = np.repeat([deviation, _CONTACT_DEVIATION], [self._num_shifts, num_contacts])
        self._noise, self._weights = noise, mask / noise
        self._patterns = derivatives * self._spread

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
        linear_coefficients = estimator @ difference
        linear_change = self._patterns @ linear_coefficients
        linear_remaining_share = float(
            self._noise_weighted_norm(difference - linear_change) / self._noise_weighted_norm(difference)
        )
        coefficients, change = np.zeros(len(estimator)), np.zeros(len(difference))
        remaining_share, max_remaining_share = 1.0, _max_remaining_share(estimator)
        for _ in range(_NUM_CORRECTIONS):
            step = estimator @ (difference - change + self._patterns @ coefficients) - coefficients
            for share in _STEP_FRACTIONS:
                try:
                    trial_change = self._change_of_voltages(coefficients + share * step)
                except ValueError:  # electrodes would overlap or leave the body
                    continue
                trial_remaining_share = float(
                    self._noise_weighted_norm(difference - trial_change) / self._noise_weighted_norm(difference)
                )
                if trial_remaining_share < remaining_share:
                    coefficients, change, remaining_share = (
                        coefficients + share * step,
                        trial_change,
                        trial_remaining_share,
                    )
                    break
            else:
                break
        # On a coarse mesh, voltages jump where an electrode passes a node, and the linear approximation is better.
        if linear_remaining_share < remaining_share:
            coefficients, change, remaining_share = linear_coefficients, linear_change, linear_remaining_share
        if remaining_share >= max_remaining_share:
            return None
        contact_factor = np.exp(self._log_contact_factors(coefficients))
        return ElectrodeChange(self._electrode_shifts(coefficients), contact_factor, change, remaining_share)

    def voltages(
        self, differences: Float[np.ndarray, "N M"], estimator: Float[np.ndarray, "p M"]
    ) -> Float[np.ndarray, "N M"]:
        """Changes of the voltages (N, M) due to changes of the electrodes, in the linear approximation with an
        `estimator`; zero for differences (N, M) of which they explain little. All are in volts."""
        coefficients = differences @ estimator.T
        changes = coefficients @ self._patterns.T
        explains_difference = self._noise_weighted_norm(differences - changes) < _max_remaining_share(
            estimator
        ) * self._noise_weighted_norm(differences)
        # If n electrodes are displaced equally, the square of the sum of squares is n times the sum of fourth powers.
        squares = (coefficients**2)[:, : self._num_shifts]
        num_electrodes = self.model.electrodes.num_electrodes
        sums_of_squares = squares.reshape(len(squares), num_electrodes, -1).sum(axis=2)
        num_effective_electrodes = sums_of_squares.sum(axis=1) ** 2 / np.maximum(
            (sums_of_squares**2).sum(axis=1), np.finfo(float).tiny
        )
        affects_several_electrodes = _is_single(estimator) | (
            num_effective_electrodes > min(_MIN_NUM_EFFECTIVE_CHANNELS, num_electrodes / 4)
        )
        is_electrode_change = self.are_suspicious(differences) & explains_difference & affects_several_electrodes
        return np.where(is_electrode_change[:, None], changes, 0.0)

    def estimator_for(self, differences: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "p M"] | None:
        """`estimator` for the largest of several differences (N, M) that shows changes of the electrodes, of many
        rather than of a single one; None if none of the `_NUM_CANDIDATE_FRAMES` largest suspicious ones does."""
        suspicious_indices = np.flatnonzero(self.are_suspicious(differences))
        largest_indices = suspicious_indices[
            np.argsort(-self._noise_weighted_norm(differences[suspicious_indices]), kind="stable")[
                :_NUM_CANDIDATE_FRAMES
            ]
        ]
        single_change_estimator = None
        for index in largest_indices:
            if (estimator := self.estimator(differences[index])) is not None:
                if not _is_single(estimator):
                    return estimator
                single_change_estimator = estimator if single_change_estimator is None else single_change_estimator
        return single_change_estimator

    def estimator(self, difference: Float[np.ndarray, " M"]) -> Float[np.ndarray, "p M"] | None:
        """Matrix (p, M) that estimates changes of the electrodes, in units of their standard deviations, from a
        difference in volts. Its standard deviations are those that best explain the `difference` (M,). None if the
        evidence is not for changes of the electrodes, or if they explain little of the difference. Of a single
        electrode, a matrix with one row that is not zero."""
        if not self.are_suspicious(difference[None])[0]:
            return None
        noise, mask = as_array(self._noise), as_array(self.mask)
        linearisation = Linearisation.create(self.model, self.background, prior=self.prior, noise=noise, mask=mask)
        estimator = _WhitenedProblem(linearisation, difference, self._patterns, self._reference).estimator()
        if estimator is None or not self.voltages(difference[None], estimator).any():
            return self._single_estimator(difference)
        return estimator

    def _single_estimator(self, difference: Float[np.ndarray, " M"]) -> Float[np.ndarray, "p M"] | None:
        """As `estimator`, for a change of the one electrode that explains most of the difference (M,); None if even
        this leaves too much, or if the change would be implausibly large."""
        rows, weighted = self._without_common_factor(self._patterns.T), self._without_common_factor(difference[None])[0]
        squares, products = np.sum(rows**2, axis=1), rows @ weighted
        explained = products**2 / np.maximum(squares, np.finfo(float).tiny)
        best = int(np.argmax(explained))
        # The linear approximation leaves up to twice as much as the displaced electrode itself.
        explains_enough = weighted @ weighted - explained[best] < (2 * _MAX_UNEXPLAINED_SHARE_OF_SINGLE_CHANGE) ** 2 * (
            weighted @ weighted
        )
        if not explains_enough or abs(products[best]) > _MAX_SINGLE_CHANGE_SIZE * squares[best]:
            return None
        estimator = np.zeros_like(rows)
        estimator[best] = rows[best] * self._weights / squares[best]
        return estimator

    def are_suspicious(self, differences: Float[np.ndarray, "N M"]) -> Bool[np.ndarray, " N"]:
        """Whether plausible changes of the electrodes alone, beside a common factor, explain enough of differences
        (N, M) to be looked for."""
        (squares, modes), weighted = self._orthogonal_combinations, self._without_common_factor(differences)
        size = np.linalg.norm(weighted, axis=1)
        error = _ASSUMED_RELATIVE_ERROR * size / np.sqrt(np.count_nonzero(self.mask))
        damped_coefficients = (weighted @ modes.T) / (squares + np.where(size > 0, error, 1)[:, None] ** 2)
        explained = np.linalg.norm(damped_coefficients @ modes, axis=1)
        return explained > _MIN_SUSPICIOUS_SHARE * size

    @functools.cached_property
    def _orthogonal_combinations(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p M"]]:
        """Orthogonal combinations (p, M) of the changes of the voltages due to plausible changes of the electrodes,
        and the squares (p,) of their norms."""
        rows = self._without_common_factor(self._patterns.T)
        squares, vectors = np.linalg.eigh(rows @ rows.T)
        return np.maximum(squares, 0), vectors.T @ rows

    def _change_of_voltages(self, coefficients: Float[np.ndarray, " p"]) -> Float[np.ndarray, " M"]:
        """Change of the voltages (M,) due to changes of the electrodes. Raises `ValueError` if they would overlap or
        leave the body."""
        described: Any = self.model.electrodes
        shift = self._electrode_shifts(coefficients)
        electrodes = shift_electrodes(described, np.asarray(described.directions(self.model.mesh)), shift)
        impedance = np.asarray(described.contact_impedance) * np.exp(self._log_contact_factors(coefficients))
        electrodes = electrodes.with_contact_impedance(impedance)
        moved = self.model.with_electrodes(electrodes)
        return np.where(self.mask, np.asarray(moved.voltages(self.background)) - self._reference, 0.0)

    def _electrode_shifts(self, coefficients: Float[np.ndarray, " p"]) -> Float[np.ndarray, "L a"]:
        return (self._spread * coefficients)[: self._num_shifts].reshape(self.model.electrodes.num_electrodes, -1)

    def _log_contact_factors(self, coefficients: Float[np.ndarray, " p"]) -> Float[np.ndarray, " L"]:
        """Changes of the logarithms of the contact impedances."""
        changes = (self._spread * coefficients)[self._num_shifts :]
        return changes if changes.size else np.zeros(self.model.electrodes.num_electrodes)

    def _without_common_factor(self, voltages: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N M"]:
        """Voltages divided by the noise of their channels, without the part that is a factor common to all."""
        weighted, level = voltages * self._weights, self._reference * self._weights
        return weighted - np.outer(weighted @ level, level) / (level @ level)

    def _noise_weighted_norm(self, voltages: Float[np.ndarray, "*N M"]) -> Float[np.ndarray, "*N"]:
        """Norm of voltages that are divided by the noise of their channels, without the part that is a factor common
        to all."""
        return np.linalg.norm(self._without_common_factor(np.atleast_2d(voltages)), axis=-1).reshape(
            voltages.shape[:-1]
        )


class _WhitenedProblem:
    """Difference, divided by the noise of its channels, in the eigenbasis of JΓJᵀ, where all covariances but those of
    the electrodes and of the common factor are diagonal."""

    def __init__(self, linearisation: Linearisation, difference, patterns, reference):
        spectrum: Any = linearisation.spectrum
        self._channels, self._num_channels = linearisation.channels, len(difference)
        self._root_weight = np.asarray(linearisation.root_weight)
        data, *columns = (
            self._root_weight * voltages[self._channels] for voltages in (difference, reference, *patterns.T)
        )
        eigenvalues = np.asarray(spectrum.eigenvalues)
        is_nonzero_eigenvalue = eigenvalues > _RANK_TOLERANCE * eigenvalues.max()
        self._basis = np.asarray(spectrum.basis)[:, is_nonzero_eigenvalue]
        self._noise_weighted_norm = float(np.sqrt(np.mean(data**2)))
        self._data = self._basis.T @ data
        self._num_others = len(data) - len(self._data)
        self._others = max(float(data @ data - self._data @ self._data), 0.0)
        self._eigenvalues = eigenvalues[is_nonzero_eigenvalue] * (len(data) / eigenvalues.sum())
        level, *patterns = (self._basis.T @ column for column in columns)
        self._level = level * (
            _MAX_COMMON_CONTACT_FACTOR * self._noise_weighted_norm * np.sqrt(len(data)) / np.linalg.norm(level)
        )
        self._patterns = np.stack(patterns, axis=1)

    def estimator(self) -> Float[np.ndarray, "p M"] | None:
        """See `ElectrodeChanges.estimator`; None if the evidence is not for changes of the electrodes."""
        options = {"maxiter": 400, "xatol": 0.02, "fatol": 0.05}
        optimum_without_change, optimum = (
            scipy.optimize.minimize(
                self._negative_log_posterior, _INITIAL_LOG_DEVIATIONS[:number], method="Nelder-Mead", options=options
            )
            for number in (3, 4)
        )
        if optimum_without_change.fun - optimum.fun < min(
            _MIN_LOG_EVIDENCE_INCREASE, _MIN_LOG_EVIDENCE_INCREASE_PER_CHANNEL * len(self._data)
        ):
            return None
        variance, columns, inner_matrix = self._covariance(optimum.x)
        rows = (
            np.exp(optimum.x[3]) * np.linalg.solve(inner_matrix, (columns / variance[:, None]).T)[:-1] @ self._basis.T
        )
        estimator = np.zeros((len(rows), self._num_channels))
        estimator[:, self._channels] = rows * self._root_weight
        return estimator

    def _covariance(self, logarithms):
        """Variances (r,), columns (r, q) and the inner matrix (q, q) of the covariance D + C Cᵀ of the data, whose
        inverse is D⁻¹ - D⁻¹ C (I + Cᵀ D⁻¹ C)⁻¹ Cᵀ D⁻¹."""
        conductivity, noise, error = np.exp(2 * logarithms[:3]) * self._noise_weighted_norm**2
        variance = conductivity * self._eigenvalues + noise + error
        columns = self._level[:, None]
        if len(logarithms) > 3:
            columns = np.column_stack([np.exp(logarithms[3]) * self._patterns, self._level])
        return variance, columns, np.eye(columns.shape[1]) + (columns.T / variance) @ columns

    def _negative_log_posterior(self, logarithms) -> float:
        """Negative logarithm of the evidence and of the prior of the `logarithms` of the standard deviations."""
        variance, columns, inner_matrix = self._covariance(logarithms)
        projected = (columns.T / variance) @ self._data
        weighted_sum_of_squares = self._data**2 @ (1 / variance) - projected @ np.linalg.solve(inner_matrix, projected)
        noise = np.exp(2 * logarithms[1]) * self._noise_weighted_norm**2
        weighted_sum_of_squares += self._others / noise
        determinant = np.log(variance).sum() + np.linalg.slogdet(inner_matrix)[1] + self._num_others * np.log(noise)
        departure = (logarithms[:3] - _INITIAL_LOG_DEVIATIONS[:3]) / _LOG_DEVIATIONS_PRIOR_WIDTH
        # Excess over the stated standard deviation.
        excess_log_deviation = 2 * max(logarithms[3], 0) if len(logarithms) > 3 else 0.0
        return 0.5 * (weighted_sum_of_squares + determinant + departure @ departure + excess_log_deviation**2)


@keep_last_result
def _voltages_and_derivatives(
    model: ForwardModel, background: float
) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, "M p"]]:
    """Voltages (M,) of a model, and their derivatives with respect to displacements, volts per metre, and, if voltages
    are measured on driven electrodes, to the logarithms of the contact impedances, volts."""
    fields, impedance = map(np.asarray, on_host(model.fields(background)))
    protocol, electrodes = on_host(model.protocol), model.electrodes
    changes = PlacementSensitivity(model.mesh, electrodes)(fields, impedance)  # pyright: ignore[reportArgumentType]
    changes = changes[: len(changes) - electrodes.num_electrodes + _num_contacts(model)]
    voltages, *derivatives = (np.asarray(select_channels(protocol, change)) for change in (impedance, *changes))
    return voltages, np.stack(derivatives, axis=1)


def _is_single(estimator: Float[np.ndarray, "p M"]) -> bool:
    """Whether an estimator is that of the change of a single electrode."""
    return np.count_nonzero(estimator.any(axis=1)) == 1


def _max_remaining_share(estimator: Float[np.ndarray, "p M"]) -> float:
    """Maximum share of a difference that may be left, or the difference is not due to changes of electrodes."""
    return _MAX_UNEXPLAINED_SHARE_OF_SINGLE_CHANGE if _is_single(estimator) else _MAX_UNEXPLAINED_DIFFERENCE_SHARE


def _num_contacts(model: ForwardModel) -> int:
    """Number of contact impedances that the voltages depend on: none unless voltages are measured on driven
    electrodes."""
    return model.electrodes.num_electrodes if model.protocol.channels_on_driven_electrodes().any() else 0
