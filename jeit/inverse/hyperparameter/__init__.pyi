from .rules import best_resolution, discrepancy, generalised_cross_validation, l_curve, noise_figure

__all__ = [
    "best_resolution",
    "discrepancy",
    "generalised_cross_validation",
    "l_curve",
    "noise_figure",
]
