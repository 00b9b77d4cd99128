"""The linear problem in the space of the data, solved for one hyperparameter without an eigendecomposition.

What is differentiated goes this way: eigenvectors of equal eigenvalues, which symmetric bodies have, have no
derivative, but the images made of them have. In the notation of `jeit.inverse.spectrum`

    R_λ = ΓJᵀK⁻¹(1 - BGᵀ) + NGᵀ,   G = K⁻¹B(BᵀK⁻¹B)⁻¹,   K = JΓJᵀ + λ²,   B = JN.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from jeit_solvers import symmetric_inverse
from jeit_solvers.engines import adjoint


class DirectProblem(eqx.Module):
    """The whitened problem in orthonormal combinations of the channels, with the answers of a `Spectrum` that images
    need.

    **Fields**: `directions` (M, r), the combinations; `jacobian` J (r, m) of them; `product` ΓJᵀ (m, r); `null_space` N
    (m, p).
    """

    directions: Float[Array, "M r"]
    jacobian: Float[Array, "r m"]
    product: Float[Array, "m r"]
    null_space: Float[Array, "m p"]

    def image(self, data: Inexact[Array, " M"], hyperparameter) -> Inexact[Array, " m"]:
        """R_λ v (m,) for whitened data v."""
        return self.reconstruction(hyperparameter) @ data

    def reconstruction(self, hyperparameter) -> Float[Array, "m M"]:
        """R_λ (m, M) for whitened data."""
        outer = self.jacobian @ self.product
        damped = (outer + adjoint(outer)) / 2 + hyperparameter**2 * jnp.eye(len(outer))
        inverse = jnp.linalg.inv(damped) if jnp.iscomplexobj(damped) else symmetric_inverse(damped)
        matrix = self.product @ inverse
        if self.null_space.shape[1]:
            seen = self.jacobian @ self.null_space
            weighted = inverse @ seen
            free = weighted @ jnp.linalg.pinv(adjoint(seen) @ weighted)
            matrix = matrix + (self.null_space - matrix @ seen) @ adjoint(free)
        return matrix @ self.directions.T
