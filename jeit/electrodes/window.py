"""Contact integrals of electrodes whose edge cuts through cells: a smooth window on a fixed quadrature."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import roots_jacobi

from jeit.electrodes.electrodes import Contact

# Half-width of a window's edge, as a share of the local cell size. Smaller is closer to the sharp electrode, until
# the edge falls between the quadrature points; see tests/electrodes for its convergence.
EDGE = 0.5


def triangle_quadrature(order: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Jacobi rule on a triangle: barycentric points (order², 3) and weights (order²,) that sum to one.

    Exact for polynomials of degree 2·order - 1 (the collapsed-square rule; Stroud 1971).
    """
    u, weight_u = np.polynomial.legendre.leggauss(order)
    v, weight_v = roots_jacobi(order, 1, 0)
    u, v = (u + 1) / 2, (v + 1) / 2
    second = np.outer(1 - v, u).ravel()
    third = np.repeat(v, order)
    weights = np.outer(weight_v, weight_u).ravel()
    return np.stack([1 - second - third, second, third], axis=1), weights / weights.sum()


def smooth_step(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Rises from 0 at x ≤ -1 to 1 at x ≥ 1 with two continuous derivatives; odd about (0, 1/2)."""
    t = jnp.clip((x + 1) / 2, 0, 1)
    return t**3 * (10 - 15 * t + 6 * t**2)


def window_contact(
    nodes: Int[Array, "q 3"],
    measure: Float[Array, " q"],
    window: Float[Array, "q p L"],
    contact_impedance: Float[Array, " L"],
    num_points: int,
) -> Contact:
    """Contact integrals from window values at the p quadrature points of q triangles.

    `measure`: areas of the triangles; `window`: share of each quadrature point that each electrode covers.
    """
    barycentric, weights = triangle_quadrature()
    admittance = window / contact_impedance
    scaled = measure[:, None] * weights
    mass = jnp.einsum("qp,pi,pj->qij", scaled * admittance.sum(axis=-1), barycentric, barycentric)
    local = jnp.einsum("qp,pi,qpl->qil", scaled, barycentric, admittance)
    load = jnp.zeros((num_points, contact_impedance.shape[0]), local.dtype).at[nodes].add(local)
    return Contact((nodes,), (mass,), load)
