"""How much of an iterative image the noise of the data would make by itself: what tells a body from a ghost."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit_solvers.engines import on_host

# Rows of an image's size at a time.
_ROWS = 32


def image_noise(reconstruction: Reconstruction) -> Float[np.ndarray, " m"]:
    """Standard deviation (m,), from the noise alone, of what an image shows in every cell, on the link's scale.

    Coefficients end at c = K (Jc - r), K = Jᵀ(JJᵀ + C)⁻¹, so that noise of covariance C makes K C Kᵀ of them. It is
    taken to be as large as it was said to be, or as what the image leaves unexplained, if that is more. Raises
    `ValueError` for total variation and bounded solvers, whose images are not of that kind.
    """
    if not reconstruction.inversion.penalty.is_standard_normal:
        raise ValueError("reconstruction: only images with smooth priors and unbounded solvers have such a noise.")
    inversion, coefficients = on_host((reconstruction.inversion, reconstruction.coefficients))
    _, jacobian = inversion.linearise(coefficients)
    covariance, count = inversion.data.covariance, inversion.basis.num_coefficients
    root = np.linalg.cholesky(covariance).T @ np.linalg.inv(jacobian @ jacobian.T + covariance)
    variance = np.zeros(len(inversion.reference))
    for start in range(0, len(root), _ROWS):
        gain = root[start : start + _ROWS] @ jacobian
        variance += np.sum([inversion.basis.expand(row[:count]) ** 2 for row in gain], axis=0)
    return max(1.0, float(reconstruction.misfit)) * np.sqrt(variance)
