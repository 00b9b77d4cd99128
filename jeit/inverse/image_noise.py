"""How much of an iterative image the noise of the data would make by itself: what tells a body from a ghost."""

import numpy as np
from jaxtyping import Float

from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit_solvers.engines import on_host


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
    covariance = inversion.data.covariance
    gain = np.linalg.solve(jacobian @ jacobian.T + covariance, jacobian)[:, : inversion.basis.num_coefficients]
    shown = np.stack([inversion.basis.expand(row) for row in gain])
    variance = np.einsum("rm,rm->m", shown, covariance @ shown)
    return max(1.0, float(reconstruction.misfit)) * np.sqrt(variance)
