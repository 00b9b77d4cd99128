"""The hyperparameter λ: rules that choose it, the curves they look at, and what all of them say of the same data."""

from __future__ import annotations

from jeit.inverse.hyperparameter.point_spread import best_resolution
from jeit.inverse.hyperparameter.rules import discrepancy, generalised_cross_validation, l_curve, noise_figure

__all__ = [
    "best_resolution",
    "discrepancy",
    "generalised_cross_validation",
    "l_curve",
    "noise_figure",
]
