"""Noise of an iterative image: its standard deviation due to the noise of the data, to distinguish bodies from
ghosts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit_solvers.engines import on_host

# Rows of an image's size at a time.
_ROWS = 32


def image_noise(reconstruction: Reconstruction) -> Float[np.ndarray, " m"]:
    """Standard deviation (m,) of an image in every cell due to the noise of the data alone, on the link's scale.

    The solution satisfies c = K (Jc - r), K = Jᵀ(JJᵀ + C)⁻¹, so that noise of covariance C gives its coefficients the
    covariance K C Kᵀ. The noise is as large as given, or as the residual of the image, if that is larger. Raises
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
