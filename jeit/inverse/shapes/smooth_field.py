"""What else than bodies there is in a solid, as a smooth field: salt that has sunk from a ball of agar to the floor, a
bath of uneven temperature, contacts that have changed. Bodies alone would bend to explain it.

    log σ/σ₀ = bodies + level · field,    field ~ N(0, Γ) as of a smooth image's prior,

so voltages that bodies do not explain have the covariance C + level² J Γ Jᵀ, J at the background; the evidence chooses
the level. Kaipio and Somersalo, Journal of Computational and Applied Mathematics 198 (2007) 493, errors of the model as
noise; MacKay, Neural Computation 4 (1992) 415, levels by evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.shapes.problem import Fit, ShapeProblem
from jeit_solvers.engines import on_host

# Tried, times the standard deviation of the smooth image's prior.
_LEVELS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True)
class SmoothField:
    """**Fields**: `image` that is smooth, of the same channels; `jacobian` (r, n) of the channels of `alone` by its
    coefficients, of unit variance, at the background; `scale` (m,), of log σ by what they are expanded to; `alone`, the
    problem of bodies and noise and nothing else."""

    image: Reconstruction
    jacobian: Float[np.ndarray, "r n"]
    scale: Float[np.ndarray, " m"]
    alone: ShapeProblem

    @classmethod
    def create(cls, image: Reconstruction, alone: ShapeProblem) -> SmoothField:
        """Raises `ValueError` for what is no `image` of the same cells and channels by a smooth prior."""
        check_kind("smooth", image, Reconstruction, "what jeit.inverse.reconstruct has returned")
        inversion = image.inversion
        if not inversion.penalty.is_standard_normal or inversion.unknowns:
            raise ValueError("smooth: give an image by a smooth prior, with no bounds and no further unknowns.")
        there = (len(inversion.data.weight), len(inversion.reference))
        if there != (wanted := (len(alone.data.weight), len(alone.background))):
            raise ValueError(
                f"smooth is an image of {there[0]} independent channels and {there[1]} cells, and the data of bodies "
                f"have {wanted[0]} and {wanted[1]}; give one by the same model and mask."
            )
        image = on_host(image)
        none: Any = np.zeros_like(image.coefficients)
        _, weighted = image.inversion.linearise(none)
        relative = np.asarray(alone.data.weight) / image.inversion.data.weight
        scale = np.asarray(inversion.link.slope(inversion.reference)) / alone.background
        return cls(image, relative[:, None] * weighted, scale, alone)

    def beside(self, level: float) -> ShapeProblem:
        """The problem of bodies with the field at a level."""
        covariance = self.alone.data.covariance + level**2 * (self.jacobian @ self.jacobian.T)
        changed = (covariance, np.linalg.inv(covariance))
        data = eqx.tree_at(lambda data: (data.covariance, data.precision), self.alone.data, changed)
        return replace(self.alone, data=data)

    def likeliest(self, fit: Fit) -> float:
        """The level of which tells what bodies leave of the voltages."""
        residual = self._left(fit)

        def surprise(level: float) -> float:
            problem = self.beside(level)
            return 0.5 * float(residual @ problem.data.precision @ residual) + problem.uncertainty

        return min(_LEVELS, key=surprise)

    def estimate(self, level: float, fit: Fit) -> Float[np.ndarray, " m"]:
        """level · field (m,), of log σ/σ₀, that explains best what the bodies leave of the voltages."""
        precision = self.beside(level).data.precision
        coefficients: Any = -(level**2) * self.jacobian.T @ (precision @ self._left(fit))
        return self.scale * np.asarray(self.image.inversion.basis.expand(coefficients))

    def _left(self, fit: Fit) -> Float[np.ndarray, " r"]:
        """What bodies predict too much of the weighted voltages."""
        return fit.rows[0][: len(self.jacobian)]
