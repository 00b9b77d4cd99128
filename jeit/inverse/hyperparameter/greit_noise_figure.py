"""How GREIT chooses λ: by the noise figure of a target in the middle of the body."""

from __future__ import annotations

import numpy as np
import scipy


def greit_noise_figure(target: float, eigenvalues, signal, level: float, painted, measure) -> float:
    """The least λ whose noise figure is `target`. Raises `ValueError` where none is.

    The figure is that of GREIT's authors, the signal-to-noise ratio of the data over that of the image of one target
    (Adler et al., Physiol. Meas. 30, S35, 2009); `noise_figure` of `rules.py` draws its signals from the prior.

    With YYᵀ = VΛVᵀ the image of data y is XYᵀV (Λ + λ²)⁻¹ Vᵀy: `signal` is Vᵀy, `painted` XYᵀV, `level` the signal of
    the data. White noise of unit variance in the data gives a cell of the image the variance Σ (XYᵀV)² / (Λ + λ²)².
    """
    weight = measure / measure.sum()
    gain = weight @ painted**2

    def excess(log_hyperparameter) -> float:
        filtered = 1 / (eigenvalues + np.exp(2 * log_hyperparameter))
        noise, image = np.sqrt(gain @ filtered**2), weight @ np.abs(painted @ (signal * filtered))
        return float(np.log(level * noise / image / target))

    grid = np.log(np.sqrt(eigenvalues.max()) * np.logspace(-6, 1, 71))
    values = np.array([excess(value) for value in grid])
    below = np.flatnonzero(values <= 0)
    if below.size == 0 or below[0] == 0:
        low, high = target * np.exp([values.min(), values.max()])
        raise ValueError(
            f"noise_figure: no hyperparameter gives {target:g}; here it lies between {low:.3g} and {high:.3g}. A "
            "larger radius brings it down; a larger noise_figure takes a noisier image."
        )
    bracket = (grid[below[0] - 1], grid[below[0]])
    return float(np.exp(scipy.optimize.root_scalar(excess, bracket=bracket, rtol=1e-10).root))
