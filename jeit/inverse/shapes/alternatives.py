"""Standard deviations of the contrasts of bodies, and alternative bodies of the other kind that explain the data about
as well."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.inverse.shapes.bodies import results_of_parts
from jeit.inverse.shapes.ellipsoid import Ellipsoid, Ellipsoids
from jeit.inverse.shapes.problem import ShapeFit, ShapeProblem

# Difference of log evidence above which only the likelier of two descriptions is reported (ellipsoid or column, one
# material or several); maximum number of steps and tolerance of the fit of an alternative description.
_UNDECIDED_LOG_EVIDENCE_DIFFERENCE, _MAX_FIT_STEPS, _COARSE_TOLERANCE = 4.0, 8, 1e-2
# Contribution of the mesh to the standard deviation of a contrast in log σ, in a sheet and in a solid. Balls of three
# times the bath's conductivity are estimated as 3.87, 3.59 and 3.31 times as conductive if edges on their surfaces are
# 0.7, 0.5 and 0.35 of the radius, and as 3.1 to 3.2 times if the edges are 0.25 of the radius. Disks of four times the
# conductivity of a sheet are estimated as 4.0 to 4.2 times on meshes of 2,000 to 8,000 nodes.
_MESH_LOG_CONTRAST_DEVIATION = {2: 0.03, 3: 0.1}


def contrast_deviations(problem: ShapeProblem, fitted: ShapeFit, free_fit: ShapeFit | None = None) -> list[float]:
    """Standard deviations of the contrasts of bodies, in log σ, including `unmodelled_deviations`."""
    return np.hypot(_body_contrasts(problem, fitted)[1], unmodelled_deviations(problem, fitted, free_fit)).tolist()


def unmodelled_deviations(
    problem: ShapeProblem, fitted: ShapeFit, free_fit: ShapeFit | None = None
) -> Float[np.ndarray, " k"]:
    """Standard deviations of the contrasts of bodies, in log σ, due to errors that Laplace's approximation of the
    problem lacks: the error of the mesh, and the choice of materials.

    `free_fit`: fit with a material for each body. If the data do not rule out this fit, the deviations allow for its
    contrasts.
    """
    variance = np.full(len(fitted.bodies.sign), _MESH_LOG_CONTRAST_DEVIATION[fitted.bodies.dimension] ** 2)
    if (
        free_fit
        and problem.negative_log_evidence(free_fit) - free_fit.bodies.odds
        < problem.negative_log_evidence(fitted) - fitted.bodies.odds + _UNDECIDED_LOG_EVIDENCE_DIFFERENCE
    ):
        fitted_contrast, deviation_of_fit = _body_contrasts(problem, fitted)
        contrast_of_free_fit, deviation_of_free_fit = _body_contrasts(problem, free_fit)
        variance += np.maximum(
            (np.abs(contrast_of_free_fit - fitted_contrast) + deviation_of_free_fit) ** 2 - deviation_of_fit**2, 0
        )
    return np.sqrt(variance)


def _body_contrasts(problem: ShapeProblem, fitted: ShapeFit) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Contrasts of the bodies of a fit in log σ, and their standard deviations from Laplace's approximation."""
    bodies = fitted.bodies
    contrasts_and_slopes = [bodies.contrast(k, body_row) for k, body_row in enumerate(bodies.rows(fitted.coefficients))]
    body_contrasts, contrast_slope = np.array(contrasts_and_slopes).reshape(-1, 2).T
    return body_contrasts, bodies.rows(problem.deviations(fitted))[:, bodies.dimension + 1] * contrast_slope


def alternatives(problem: ShapeProblem, fitted: ShapeFit) -> list[tuple[Ellipsoid | None, float]]:
    """For each body, the body of the other kind (ellipsoid or column) that explains the data about as well, and the
    standard deviation of this alternative body's contrast; None and NaN if there is no alternative. The prior odds of
    kinds are ignored."""
    bodies, num_bodies = fitted.bodies, len(fitted.bodies.sign)
    if not num_bodies or bodies.prior.is_of_one_kind or not isinstance(bodies, Ellipsoids):
        return [(None, np.nan)] * num_bodies
    max_surprise = problem.negative_log_evidence(fitted) - bodies.odds + _UNDECIDED_LOG_EVIDENCE_DIFFERENCE

    def alternative_of_body(k: int) -> tuple[Ellipsoid | None, float]:
        if bodies.is_kind_certain[k]:
            return None, np.nan
        other_fit = problem.fit(*bodies.with_other_kind([k], fitted.coefficients), _MAX_FIT_STEPS, _COARSE_TOLERANCE)
        if problem.negative_log_evidence(other_fit) - other_fit.bodies.odds >= max_surprise:
            return None, np.nan
        return other_fit.bodies.body(k, other_fit.coefficients), contrast_deviations(problem, other_fit)[k]

    return results_of_parts(bodies, alternative_of_body, range(num_bodies))
