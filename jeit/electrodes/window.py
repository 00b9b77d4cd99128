"""Contact integrals of electrodes whose edge cuts through cells: a smooth window on a fixed quadrature."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import roots_jacobi

from jeit.electrodes.electrodes import Contact
from jeit_solvers.engines import host, namespace, sum_into, undifferentiated

# Half-width of a window's edge, as a share of the local cell size. Smaller is closer to the sharp electrode, until
# the edge falls between the quadrature points; see tests/electrodes for its convergence.
EDGE = 0.5
_MOST_AT_ONCE = 8


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
    t = namespace(x).clip((x + 1) / 2, 0, 1)
    return t**3 * (10 - 15 * t + 6 * t**2)


def nearest_electrodes(middles, position, radius) -> Int[Array, "q k"]:
    """Electrodes (q, k) that can reach the triangles with these `middles` (q, d), k being 8 unless there are fewer.

    Of round electrodes, `position` (L, d) and `radius` (L,), that do not overlap, no more than that reach a triangle,
    unless it is so much larger than they are that the mesh is refused. Not differentiated.
    """
    xp = namespace(middles, position, radius)
    distance = xp.sum((middles[:, None] - position) ** 2, axis=-1) - radius**2
    distance = undifferentiated(distance).astype(np.float32)  # the order of the farthest does not matter
    number = min(_MOST_AT_ONCE, len(radius))
    if xp is np:
        return host.argsort(distance, axis=1, kind="stable")[:, :number]
    return jax.lax.top_k(-distance, number)[1]


def window_contact(
    nodes: Int[Array, "q 3"],
    measure: Float[Array, " q"],
    window: Float[Array, "q k p"],
    electrode: Int[Array, "q k"],
    contact_impedance: Float[Array, " L"],
    num_points: int,
) -> Contact:
    """Contact integrals from window values at the p quadrature points of q triangles.

    `measure`: areas of the triangles; `window`: share that each `electrode` covers of each quadrature point.
    """
    barycentric, weights = triangle_quadrature()
    current = measure[:, None, None] * weights * window / contact_impedance[electrode][..., None]
    products = (barycentric[:, :, None] * barycentric[:, None]).reshape(len(weights), -1)
    mass = (current.sum(axis=1) @ products).reshape(-1, *2 * barycentric.shape[1:])
    shape = num_points, contact_impedance.shape[0]
    load = sum_into(shape, (nodes[:, None], electrode[..., None]), current @ barycentric)
    return Contact((nodes,), (mass,), load)
