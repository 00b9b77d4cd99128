"""Least squares for coefficients of stars: ½ rᵀ G r + ½ ‖c‖² + ½ Σ (apart · overlap)², r = w (v(σ(c)) - ŷ)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Float

from jeit.forward import ForwardModel
from jeit.forward.model import evaluate, voltages_and_jacobian_of
from jeit.inverse.channels import Data
from jeit.inverse.shapes.star import Stars
from jeit_solvers import Descent, QuadraticModel, ridge_model


@dataclass(frozen=True)
class ShapeProblem:
    """**Fields**: `model` of the independent channels; `data` with ŷ, w and G; `background` σ₀ (m,), S/m (2-D: S)."""

    model: ForwardModel
    data: Data
    background: Float[np.ndarray, " m"]

    def quadratic_model(self, coefficients: Float[np.ndarray, " n"], stars: Stars) -> QuadraticModel:
        """Cost and step, for `jeit_solvers.Descent`."""
        image, slope, overlap, overlap_slope = stars.image(coefficients)
        conductivity = self.background * np.exp(image)
        voltages, jacobian = evaluate(self.model, voltages_and_jacobian_of, conductivity)
        weight = np.asarray(self.data.weight)
        rows = weight[:, None] * (np.asarray(jacobian) @ (conductivity[:, None] * slope))
        residual = weight * (np.asarray(voltages) - self.data.voltages)
        # That stars keep apart is one more datum of unit variance for every two of them.
        apart, more = stars.prior.apart, np.eye(len(overlap))
        model: list[Any] = [
            np.concatenate([residual, apart * overlap]),
            np.concatenate([rows, apart * overlap_slope]),
            coefficients,
            scipy.linalg.block_diag(self.data.covariance, more),
            scipy.linalg.block_diag(self.data.precision, more),
        ]
        return ridge_model(*model)

    def fit(self, stars: Stars, start: Float[np.ndarray, " n"], max_steps: int, rtol: float = 3e-3):
        """Coefficients of least cost near `start`, and that cost; by Levenberg-Marquardt."""
        descent = Descent(rtol=rtol, damping=1.0, history=max_steps + 1)
        coefficients, state = descent.at_once(self.quadratic_model, start, stars, max_steps)
        return coefficients, float(state.cost)
