"""Nonlinear least squares problem of bodies, optionally with other changes in addition to the bodies.

In a solid, a smooth conductivity field represents other changes of conductivity: salt that has sunk from a ball of agar
to the floor, uneven temperature of the bath, or changes of contacts. Without the field, bodies would be distorted to
explain these changes.

    log σ/σ₀ = bodies + level · field,    field ~ N(0, Γ), where Γ is the covariance of a smooth image's prior.

In a sheet, the other changes are those of the electrodes between the two frames: displacements and contact impedances,
normal with the covariance Γ. Without them, further bodies at the edge would explain these changes.

The voltages that the bodies do not explain have the covariance C + level² J Γ Jᵀ, with the noise covariance C and the
Jacobian J at the background. The level is chosen by the evidence. Kaipio and Somersalo, Journal of Computational and
Applied Mathematics 198 (2007) 493, treat model errors as noise; MacKay, Neural Computation 4 (1992) 415, chooses
hyperparameters by evidence.

The coefficients c of the bodies minimise ½ rᵀ G r + ½ ‖c‖² + ½ Σ (apart · overlap)², with r = w (v(σ(c)) - ŷ), the
predicted voltages v, the data ŷ, their weights w and their precision G = C⁻¹; the sum is over pairs of bodies.

The evidence is the probability of the data, integrated over the coefficients. It serves to compare descriptions with
different numbers and kinds of bodies. Laplace's approximation at the minimum gives -log evidence = cost + ½ log det H +
const, where H = 1 + JᵀC⁻¹J is the Hessian in units of the prior and J the Jacobian with respect to c: the more
precisely the data determine a coefficient, the more it increases -log evidence. MacKay, Neural Computation 4 (1992)
415, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.forward.changes import ConductivityChange, PlacementSensitivity, SolvedFields, solved_fields
from jeit.forward.model import select_channels
from jeit.inverse.channels import Data
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.shapes.bodies import Bodies
from jeit.protocol import Protocol
from jeit_solvers import Descent, QuadraticModel, check_not_abandoned, ridge_model
from jeit_solvers.engines import on_host

# Levels of the other changes that are tried, in units of their prior standard deviations: of a smooth field, and of
# changes of the electrodes.
_SMOOTH_FIELD_LEVELS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
_MOVED_ELECTRODE_LEVELS = _SMOOTH_FIELD_LEVELS[:-1]
# Standard deviation of the change of the logarithm of each contact impedance, at level 1.
_CONTACT_DEVIATION = 0.3
# Number of conductivities of which a problem keeps the fields.
_NUM_RECENT_FIELDS = 6


@dataclass(frozen=True)
class OtherChanges:
    """Changes in addition to the bodies, which are modelled as normal random coefficients.

    **Fields**: `jacobian` (r, n): derivatives of the weighted channels of `bodies_problem` with respect to the
    coefficients of unit variance, at the background; `bodies_problem`: the problem of bodies without these changes;
    `levels`: factors of the coefficients among which the evidence chooses.
    """

    jacobian: Float[np.ndarray, "r n"]
    bodies_problem: ShapeProblem
    levels: tuple[float, ...]

    def problem_at(self, level: float) -> ShapeProblem:
        """The problem of bodies with the changes of this `level` as additional noise."""
        return self.bodies_problem.with_errors(level * self.jacobian)

    def most_likely_level(self, fit: ShapeFit) -> float:
        """Level of the changes with the largest evidence, given the voltages that the bodies of a `fit` do not
        explain."""
        residual = self._residual(fit)

        def negative_log_evidence(candidate_level: float) -> float:
            problem = self.problem_at(candidate_level)
            return 0.5 * float(residual @ problem.data.precision @ residual) + problem.half_log_determinant

        return min(self.levels, key=negative_log_evidence)

    def conductivity(self, level: float, fit: ShapeFit) -> Any:
        """Posterior mean of the part of the changes that is of conductivity, in log σ/σ₀ (m,), given the voltages that
        the bodies of a `fit` do not explain; 0 if no part is."""
        return 0.0

    def voltages(self, level: float, fit: ShapeFit, protocol: Protocol) -> Any:
        """Posterior mean of the changes of the voltages (M,) of a `protocol`, volts, that are not due to conductivity,
        given the voltages that the bodies of a `fit` do not explain; 0 if there are none."""
        return 0.0

    def _mean_coefficients(self, level: float, fit: ShapeFit) -> Any:
        """Posterior mean (n,) of the coefficients times the `level`."""
        precision = self.problem_at(level).data.precision
        return -(level**2) * self.jacobian.T @ (precision @ self._residual(fit))

    def _residual(self, fit: ShapeFit) -> Float[np.ndarray, " r"]:
        """Residual of the weighted voltages: voltages predicted for the bodies of a `fit` minus measured voltages."""
        return fit.rows[0][: len(self.jacobian)]


@dataclass(frozen=True)
class MovedElectrodes(OtherChanges):
    """Displacements of electrodes on the edge of a sheet, and changes of their contact impedances, between two frames.

    **Field** besides those of `OtherChanges`: `impedance_changes` (n, L, L): changes of the transfer impedances of L
    electrodes, ohms, for coefficients of unit variance.
    """

    impedance_changes: Float[np.ndarray, "n L L"]

    @classmethod
    def create(cls, bodies_problem: ShapeProblem, deviation: float) -> MovedElectrodes | None:
        """Create the changes with displacements of a standard `deviation`, metres, for a problem of bodies. None for
        other electrodes, which move in two directions and thereby explain most of what bodies do, and if `deviation` is
        0."""
        model: Any = bodies_problem.model
        if not isinstance(model.electrodes, BoundaryElectrodes) or model.mesh.dimension != 2 or deviation == 0:
            return None
        fields, impedance = map(np.asarray, on_host(model.fields(bodies_problem.background)))
        impedance_derivatives = PlacementSensitivity(model.mesh, model.electrodes)(fields, impedance)
        num_contacts = model.electrodes.num_electrodes
        parameter_deviations = np.repeat(
            [deviation, _CONTACT_DEVIATION], [len(impedance_derivatives) - num_contacts, num_contacts]
        )
        impedance_changes = parameter_deviations[:, None, None] * impedance_derivatives
        jacobian = np.asarray(bodies_problem.data.weight)[:, None] * _channels_of(model.protocol, impedance_changes)
        return cls(jacobian, bodies_problem, _MOVED_ELECTRODE_LEVELS, impedance_changes)

    def voltages(self, level: float, fit: ShapeFit, protocol: Protocol) -> Float[np.ndarray, " M"]:
        """Posterior mean of the changes of the voltages (M,) of a `protocol`, volts, given the voltages that the bodies
        of a `fit` do not explain."""
        return _channels_of(protocol, self.impedance_changes) @ self._mean_coefficients(level, fit)


def _channels_of(protocol: Protocol, impedances: Float[np.ndarray, "n L L"]) -> Float[np.ndarray, "M n"]:
    """Voltages (M, n) of the channels of a protocol for each of n matrices (L, L) of transfer impedances."""
    protocol = on_host(protocol)
    return np.stack([np.asarray(select_channels(protocol, impedance)) for impedance in impedances], axis=1)


@dataclass(frozen=True)
class SmoothField(OtherChanges):
    """Smooth conductivity field in addition to the bodies, modelled as a normal random field.

    **Fields** besides those of `OtherChanges`, whose coefficients are those of the field: `image`: a smooth
    reconstruction from the same channels, whose basis is also the basis of the field; `scale` (m,): derivative of log σ
    with respect to the variable of the image's link.
    """

    image: Reconstruction
    scale: Float[np.ndarray, " m"]

    @classmethod
    def create(cls, image: Reconstruction, bodies_problem: ShapeProblem) -> SmoothField:
        """Create a smooth field from a smooth reconstruction `image`, for the problem of bodies `bodies_problem`.

        Raises `ValueError` unless `image` is a reconstruction of the same cells and channels with a smooth prior.
        """
        check_kind("smooth", image, Reconstruction, "what jeit.inverse.reconstruct has returned")
        inversion = image.inversion
        if not inversion.penalty.is_standard_normal or inversion.unknowns:
            raise ValueError("smooth: give an image by a smooth prior, with no bounds and no further unknowns.")
        image_sizes = (len(inversion.data.weight), len(inversion.reference))
        if image_sizes != (problem_sizes := (len(bodies_problem.data.weight), len(bodies_problem.background))):
            raise ValueError(
                f"smooth is an image of {image_sizes[0]} independent channels and {image_sizes[1]} cells, and the "
                f"data of bodies have {problem_sizes[0]} and {problem_sizes[1]}; give one by the same model and mask."
            )
        image = on_host(image)
        zero_coefficients: Any = np.zeros_like(image.coefficients)
        _, weighted_jacobian = image.inversion.linearise(zero_coefficients)
        weight_ratio = np.asarray(bodies_problem.data.weight) / image.inversion.data.weight
        log_conductivity_slope = np.asarray(inversion.link.slope(inversion.reference)) / bodies_problem.background
        return cls(
            weight_ratio[:, None] * weighted_jacobian,
            bodies_problem,
            _SMOOTH_FIELD_LEVELS,
            image,
            log_conductivity_slope,
        )

    def conductivity(self, level: float, fit: ShapeFit) -> Float[np.ndarray, " m"]:
        """Posterior mean (m,) of the smooth field, level · field in log σ/σ₀, given the voltages that the bodies of a
        `fit` do not explain."""
        return self.scale * np.asarray(self.image.inversion.basis.expand(self._mean_coefficients(level, fit)))


class ShapeFit(NamedTuple):
    """Result of `ShapeProblem.fit`.

    **Fields**: `bodies`; `coefficients` (n,): coefficients of the bodies at the minimum; `cost`: objective at the
    minimum; `rows`: residual and Jacobian at the minimum, not multiplied by the precision of the data.
    """

    bodies: Bodies
    coefficients: Float[np.ndarray, " n"]
    cost: float
    rows: tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r n"]]


class _RecentFields:
    """Cache of the fields of one model for the last few conductivities, which are compared by value."""

    def __init__(self):
        self._solved: list[tuple[Float[np.ndarray, " m"], SolvedFields]] = []

    def at(self, model: ForwardModel, conductivity: Float[np.ndarray, " m"]) -> SolvedFields:
        """The fields of the `model` for a `conductivity`, solved now or taken from the cache."""
        for known_conductivity, solved in self._solved[::-1]:
            if np.array_equal(known_conductivity, conductivity):
                return solved
        solved = solved_fields(model, conductivity)
        self._solved = [*self._solved, (conductivity, solved)][-_NUM_RECENT_FIELDS:]
        return solved


@dataclass(frozen=True)
class ShapeProblem:
    """Least squares problem for the coefficients of bodies.

    **Fields**: `model`: forward model of the independent channels; `data`: independent voltages ŷ, their weights w and
    precision G; `background` (m,): σ₀, S/m (2-D: S); `rtol`: relative change of the cost that ends a fit;
    `recent_fields`: the last solutions, because a fit often begins where another fit has ended.
    """

    model: ForwardModel
    data: Data
    background: Float[np.ndarray, " m"]
    rtol: float = 3e-3
    recent_fields: _RecentFields = field(default_factory=_RecentFields, compare=False)

    def misfit(self, fit: ShapeFit) -> float:
        """Misfit of the voltages of a `fit` in standard deviations of the data, errors of the data included."""
        residual = fit.rows[0][: len(self.data.voltages)]
        # The form is negative by rounding where errors that the model explains exceed all others many times.
        return float(np.sqrt(max(residual @ np.asarray(self.data.precision) @ residual, 0.0) / len(residual)))

    def with_scaled_errors(self, factor: float) -> ShapeProblem:
        """Copy of the problem with all errors of the data multiplied by a `factor`."""
        new_matrices = (factor**2 * np.asarray(self.data.covariance), np.asarray(self.data.precision) / factor**2)
        return replace(
            self,
            data=eqx.tree_at(lambda shape_data: (shape_data.covariance, shape_data.precision), self.data, new_matrices),
        )

    def with_errors(self, rows: Float[np.ndarray, "r q"]) -> ShapeProblem:
        """Copy of the problem with further errors of the data: `rows` (r, q) are the errors of the r weighted voltages
        per unit of each of q coefficients of unit variance."""
        covariance = np.asarray(self.data.covariance) + rows @ rows.T
        new_matrices = (covariance, np.linalg.inv(covariance))
        return replace(
            self,
            data=eqx.tree_at(lambda shape_data: (shape_data.covariance, shape_data.precision), self.data, new_matrices),
        )

    def linearise(self, coefficients: Float[np.ndarray, " n"], bodies: Bodies) -> tuple[Any, Any, Any, Any]:
        """Residual (r + p,), a function that returns its Jacobian (r + p, n), its covariance and its precision
        (r + p, r + p), for r channels and p pairs of bodies."""
        check_not_abandoned()
        image, image_slopes, pair_overlaps, pair_overlap_slopes = bodies.image(coefficients)
        conductivity = self.background * np.exp(image)
        fields = self.recent_fields.at(self.model, conductivity)
        data_weight = np.asarray(self.data.weight)
        # The penalty on the overlap of bodies is an additional datum of unit variance for every pair of bodies.
        overlap_weight, pair_identity = bodies.prior.apart, np.eye(len(pair_overlaps))

        def jacobian():
            cell_conductivities = [conductivity if cells is None else conductivity[cells] for cells, _ in image_slopes]
            conductivity_changes = [
                ConductivityChange(cells, cell_values[:, None] * image_slope)
                for cell_values, (cells, image_slope) in zip(cell_conductivities, image_slopes, strict=True)
            ]
            voltages = bodies.by_coefficients(fields.derivatives(conductivity_changes))
            return np.concatenate([data_weight[:, None] * voltages, overlap_weight * pair_overlap_slopes])

        return (
            np.concatenate([data_weight * (fields.voltages - self.data.voltages), overlap_weight * pair_overlaps]),
            jacobian,
            scipy.linalg.block_diag(self.data.covariance, pair_identity),
            scipy.linalg.block_diag(self.data.precision, pair_identity),
        )

    def fit(
        self, bodies: Bodies, start: Float[np.ndarray, " n"], max_steps: int, rtol: float | None = None
    ) -> ShapeFit:
        """Minimise the cost of `bodies` from the coefficients `start` by the Levenberg-Marquardt method, in at most
        `max_steps` steps."""
        undefined_rows = np.full((len(self.data.voltages), 1 + len(start)), np.nan)
        accepted_values: list[Any] = [undefined_rows[:, 0], undefined_rows[:, 1:]]

        def expand(coefficients, bodies) -> QuadraticModel:
            residual, jacobian, covariance, precision = self.linearise(coefficients, bodies)
            objective_value = 0.5 * (residual @ precision @ residual + coefficients @ coefficients)

            def damped_step(damping):  # the Jacobian is computed only at points that are accepted
                jacobian_rows = jacobian()
                accepted_values[:] = residual, jacobian_rows
                return ridge_model(residual, jacobian_rows, coefficients, covariance, precision)[1](damping)  # pyright: ignore

            return objective_value, damped_step

        gauss_newton_descent = Descent(rtol=rtol or self.rtol, damping=1.0, history=max_steps + 1)
        coefficients, descent_state = gauss_newton_descent.at_once(expand, start, bodies, max_steps)
        return ShapeFit(bodies, coefficients, float(descent_state.cost), (accepted_values[0], accepted_values[1]))

    @property
    def half_log_determinant(self) -> float:
        """Half the logarithm of the determinant of the data's covariance, the covariance's contribution to -log
        evidence."""
        return 0.5 * float(np.linalg.slogdet(np.asarray(self.data.covariance))[1])

    def negative_log_evidence(self, fit: ShapeFit) -> float:
        """Negative log evidence of the bodies of a `fit`, up to a constant, including the prior odds against their
        kinds."""
        return fit.cost + 0.5 * float(np.linalg.slogdet(self._hessian(fit))[1]) + fit.bodies.odds

    def covariance(self, fit: ShapeFit) -> Float[np.ndarray, "n n"]:
        """Posterior covariance (n, n) of the coefficients of the bodies of a `fit`, from Laplace's approximation."""
        return np.linalg.inv(self._hessian(fit))

    def deviations(self, fit: ShapeFit) -> Float[np.ndarray, " n"]:
        """Posterior standard deviations (n,) of the coefficients of a `fit`, from Laplace's approximation."""
        return np.sqrt(np.diag(self.covariance(fit)))

    def _hessian(self, fit: ShapeFit) -> Float[np.ndarray, "n n"]:
        """Hessian H (n, n) of the cost at its minimum."""
        _, jacobian_rows = fit.rows
        num_channels = len(self.data.voltages)
        weighted_rows = np.concatenate(
            [self.data.precision @ jacobian_rows[:num_channels], jacobian_rows[num_channels:]]
        )
        return np.eye(len(fit.coefficients)) + jacobian_rows.T @ weighted_rows
