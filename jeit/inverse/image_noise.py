"""Standard deviation of an iterative image due to the noise of the data, used to distinguish inclusions from
artefacts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit_solvers.engines import on_host

# Number of rows of the size of an image computed at a time.
_ROWS = 32


def image_noise(reconstruction: Reconstruction) -> Float[np.ndarray, " m"]:
    """Standard deviation (m,) of an image in every cell due to the noise of the data alone, on the link's scale.

    The coefficients at the solution satisfy c = K (Jc - r) with K = Jᵀ(JJᵀ + C)⁻¹, so noise of covariance C gives them
    the covariance K C Kᵀ. If the image's misfit exceeds 1, the standard deviation is multiplied by it. Raises
    `ValueError` for total variation and bounded solvers, to which this does not apply.
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
