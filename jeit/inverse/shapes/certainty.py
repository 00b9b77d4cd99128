"""How surely bodies are told: the deviations of their contrasts, and what else they may be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.inverse.shapes.ellipsoid import Ellipsoid, Ellipsoids
from jeit.inverse.shapes.problem import Fit, ShapeProblem

# How much likelier (of the logarithm) one kind of body has to make the data than the other, or one material than
# several, not to be told as one of two. Steps to what else may be, and how precisely.
_UNDECIDED, _STEPS, _ROUGHLY = 4.0, 8, 1e-2
# What the mesh adds to the deviation of a solid body's contrast, of log σ: balls of three times the bath are told as
# 3.87, 3.59 and 3.31 times where edges on their surfaces are 0.7, 0.5 and 0.35 of the radius, and as 3.1 to 3.2 times
# where they are 0.25.
_BY_THE_MESH = 0.1


def contrast_deviations(problem: ShapeProblem, fitted: Fit, each: Fit | None = None) -> list[float]:
    """Standard deviations of the contrasts of bodies; of those of one material so large that they reach the deviation
    of `each` for itself too, where the data do not tell that they are."""
    contrast, deviation = _contrasts(problem, fitted)
    if each and problem.surprise(each) - each.bodies.odds < problem.surprise(fitted) - fitted.bodies.odds + _UNDECIDED:
        own, its = _contrasts(problem, each)
        deviation = np.maximum(deviation, np.abs(own - contrast) + its)
    return [float(one) for one in np.hypot(deviation, _BY_THE_MESH * (fitted.bodies.dimension == 3))]


def _contrasts(problem: ShapeProblem, fitted: Fit) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Contrasts of bodies, and their standard deviations by Laplace's approximation."""
    bodies = fitted.bodies
    told = [bodies.contrast(k, row) for k, row in enumerate(bodies.rows(fitted.coefficients))]
    contrast, slope = np.array(told).reshape(-1, 2).T
    return contrast, bodies.rows(problem.deviations(fitted))[:, bodies.dimension + 1] * slope


def alternatives(problem: ShapeProblem, fitted: Fit) -> list[tuple[Ellipsoid | None, float]]:
    """Every ellipsoid as a column, and every column as an ellipsoid, that explains the data about as well, whichever is
    more likely beforehand; and the deviation of its contrast."""
    bodies, number = fitted.bodies, len(fitted.bodies.sign)
    if not number or bodies.prior.is_of_one_kind or not isinstance(bodies, Ellipsoids):
        return [(None, np.nan)] * number
    most, found = problem.surprise(fitted) - bodies.odds + _UNDECIDED, []
    for k in range(number):
        other = problem.fit(*bodies.otherwise([k], fitted.coefficients), _STEPS, _ROUGHLY)
        if problem.surprise(other) - other.bodies.odds < most:
            found.append((other.bodies.body(k, other.coefficients), contrast_deviations(problem, other)[k]))
        else:
            found.append((None, np.nan))
    return found
