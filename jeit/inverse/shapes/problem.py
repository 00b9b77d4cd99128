"""Least squares for the coefficients of bodies: ½ rᵀ G r + ½ ‖c‖² + ½ Σ (apart · overlap)², r = w (v(σ(c)) - ŷ).

How well some bodies explain the data, number and kind open, is told by the evidence, the probability of the data
whatever the coefficients. By Laplace's approximation at the least cost, -log evidence = cost + ½ log det H + const,
with H = 1 + JᵀC⁻¹J the Hessian in units of the prior: every coefficient costs as much as it has to be told precisely.
MacKay, Neural Computation 4 (1992) 415, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float

from jeit.forward import ForwardModel
from jeit.forward.changes import Change, solved_fields
from jeit.inverse.channels import Data
from jeit.inverse.shapes.bodies import Bodies
from jeit_solvers import Descent, QuadraticModel, ridge_model


class Fit(NamedTuple):
    """Bodies and their `coefficients` (n,) of least `cost`; there, the residual and its Jacobian as `rows`, of the
    problem that they were fitted to, whatever its covariance."""

    bodies: Bodies
    coefficients: Float[np.ndarray, " n"]
    cost: float
    rows: tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r n"]]


@dataclass(frozen=True)
class ShapeProblem:
    """**Fields**: `model` of the independent channels; `data` with ŷ, w and G; `background` σ₀ (m,), S/m (2-D: S);
    `rtol` of the cost, to which it is fitted."""

    model: ForwardModel
    data: Data
    background: Float[np.ndarray, " m"]
    rtol: float = 3e-3

    def linearise(self, coefficients: Float[np.ndarray, " n"], bodies: Bodies) -> tuple[Any, Any, Any, Any]:
        """Residual (r + p,), a function that gives its Jacobian (r + p, n), covariance and precision (r + p, r + p)."""
        image, slopes, overlap, overlap_slope = bodies.image(coefficients)
        conductivity = self.background * np.exp(image)
        fields = solved_fields(self.model, conductivity)
        weight = np.asarray(self.data.weight)
        # That bodies keep apart is one more datum of unit variance for every two of them.
        apart, more = bodies.prior.apart, np.eye(len(overlap))

        def jacobian():
            there = [conductivity if cells is None else conductivity[cells] for cells, _ in slopes]
            changes = [Change(cells, one[:, None] * slope) for one, (cells, slope) in zip(there, slopes, strict=True)]
            voltages = bodies.by_coefficients(fields.derivatives(changes))
            return np.concatenate([weight[:, None] * voltages, apart * overlap_slope])

        return (
            np.concatenate([weight * (fields.voltages - self.data.voltages), apart * overlap]),
            jacobian,
            scipy.linalg.block_diag(self.data.covariance, more),
            scipy.linalg.block_diag(self.data.precision, more),
        )

    def fit(self, bodies: Bodies, start: Float[np.ndarray, " n"], max_steps: int, rtol: float | None = None) -> Fit:
        """The least cost near `start`, by Levenberg-Marquardt."""
        unknown = np.full((len(self.data.voltages), 1 + len(start)), np.nan)
        accepted: list[Any] = [unknown[:, 0], unknown[:, 1:]]

        def expand(coefficients, bodies) -> QuadraticModel:
            residual, jacobian, covariance, precision = self.linearise(coefficients, bodies)
            cost = 0.5 * (residual @ precision @ residual + coefficients @ coefficients)

            def step(damping):  # points that are refused need no Jacobian
                rows = jacobian()
                accepted[:] = residual, rows
                return ridge_model(residual, rows, coefficients, covariance, precision)[1](damping)  # pyright: ignore

            return cost, step

        descent = Descent(rtol=rtol or self.rtol, damping=1.0, history=max_steps + 1)
        coefficients, state = descent.at_once(expand, start, bodies, max_steps)
        return Fit(bodies, coefficients, float(state.cost), (accepted[0], accepted[1]))

    @property
    def uncertainty(self) -> float:
        """What the covariance of the data adds to the -log evidence: half the logarithm of its determinant."""
        return 0.5 * float(np.linalg.slogdet(np.asarray(self.data.covariance))[1])

    def surprise(self, fit: Fit) -> float:
        """-log evidence of some bodies, up to a constant, with the odds against their kinds."""
        return fit.cost + 0.5 * float(np.linalg.slogdet(self._hessian(fit))[1]) + fit.bodies.odds

    def deviations(self, fit: Fit) -> Float[np.ndarray, " n"]:
        """Standard deviations of the coefficients after the data, by Laplace's approximation."""
        return np.sqrt(np.diag(np.linalg.inv(self._hessian(fit))))

    def _hessian(self, fit: Fit) -> Float[np.ndarray, "n n"]:
        """H at the least cost."""
        _, rows = fit.rows
        channels = len(self.data.voltages)
        weighed = np.concatenate([self.data.precision @ rows[:channels], rows[channels:]])
        return np.eye(len(fit.coefficients)) + rows.T @ weighed
