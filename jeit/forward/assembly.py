"""P1 finite elements: conductivity per cell, element stiffness, and gradients of nodal fields."""

from __future__ import annotations

import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from jeit.mesh import Mesh, gradients, measures, normals
from jeit_solvers.engines import gather, has_values, namespace


def cell_conductivity(mesh: Mesh, conductivity) -> Inexact[Array, "m ..."]:
    """Conductivity per cell, (m,) or tensor (m, d, d), from a per-cell, per-node or tensor one, S/m (2-D: S).

    A conductivity given per node is linear in each cell; as P1 gradients are constant there, its mean over the
    cell's nodes is exact.
    """
    if conductivity.ndim == 1 and conductivity.shape[0] != mesh.num_cells:
        return gather(conductivity, mesh.cells).mean(axis=1)
    return conductivity


def check_conductivity(mesh: Mesh, conductivity) -> Inexact[Array, "..."]:
    """Convert `conductivity` to an array and raise `ValueError` if it has the wrong shape or is not positive.

    Accepts a scalar, which comes back as (m,), (m,) per cell, (n,) per node or (m, s, s) symmetric tensors, s being the
    dimension of space; siemens per metre (in a 2-D sheet, siemens). Of tensors (m, 3, 3) on a surface in space only the
    part in each triangle's plane counts. A complex admittivity needs a positive real part. Values of tracers are not
    looked at.
    """
    conductivity = np.asarray(conductivity) if has_values(conductivity) else jnp.asarray(conductivity)
    # One type and shape for all that mean the same, or JAX compiles again: Python's numbers are "weakly" typed.
    conductivity = namespace(conductivity).asarray(conductivity, dtype=_floating(conductivity.dtype))
    m, n, d = mesh.num_cells, mesh.num_points, mesh.space_dimension
    if conductivity.shape not in [(), (m,), (n,), (m, d, d)]:
        raise ValueError(
            f"conductivity has shape {conductivity.shape}; give a scalar, one value per cell ({m},), one per node "
            f"({n},), or tensors ({m}, {d}, {d}). For a batch, use jax.vmap."
        )
    if has_values(conductivity):
        _check_values(conductivity, np.asarray(normals(mesh)) if mesh.is_surface and has_values(mesh.points) else None)
    return namespace(conductivity).broadcast_to(conductivity, conductivity.shape or (m,))


def _floating(kind: Any) -> Any:
    """The type of floating-point numbers for values of some type. Raises `ValueError` for what are no numbers."""
    if kind.kind in "OSUmM":
        raise ValueError(f"conductivity is {kind}; give real or complex numbers, S/m (2-D: S).")
    if kind.kind in "biu" or kind.itemsize > 16 or (kind.kind == "f" and kind.itemsize > 8):
        return jnp.result_type(complex if kind.kind == "c" else float)
    return jax.dtypes.canonicalize_dtype(kind.newbyteorder("="))


def _check_values(conductivity: Any, normal: Any) -> None:
    if not np.isfinite(conductivity).all():
        raise ValueError("conductivity has NaN or infinite values.")
    if conductivity.ndim == 3:
        if not np.allclose(conductivity, np.swapaxes(conductivity, 1, 2), rtol=1e-12, atol=0):
            raise ValueError("conductivity tensors must be symmetric.")
        real = conductivity.real
        if normal is not None:  # only across it must they be positive: put a large value along it
            along = normal[:, :, None] * normal[:, None]
            across = np.eye(3) - along
            real = across @ real @ across + np.abs(real).max() * along
        least = np.linalg.eigvalsh(real).min()
    else:
        least = conductivity.real.min()
    if least <= 0:
        raise ValueError(
            f"conductivity must be positive everywhere; its least value is {least:.3g}. For an insulating "
            "inclusion use a small positive value, such as a thousandth of the background."
        )


def stiffness(mesh: Mesh, conductivity: Inexact[Array, "m ..."]) -> Inexact[Array, "p m"]:
    """Element stiffness ∫ ∇φ_i·σ∇φ_j for conductivity per cell: lower triangles (p, m), p = (d+1)(d+2)/2, siemens."""
    xp = namespace(mesh, conductivity)
    gradient = gradients(mesh)  # (m, d + 1, d)
    flux = gradient if conductivity.ndim == 1 else xp.einsum("mij,mkj->mki", conductivity, gradient)
    weight = measures(mesh) * (conductivity if conductivity.ndim == 1 else 1)
    rows, columns = np.tril_indices(mesh.dimension + 1)
    return xp.stack(
        [
            weight * sum(gradient[:, row, axis] * flux[:, column, axis] for axis in range(mesh.space_dimension))
            for row, column in zip(rows, columns, strict=True)
        ]
    )


def field_gradients(mesh: Mesh, fields: Inexact[Array, "n p"]) -> Inexact[Array, "d m p"]:
    """Gradients of nodal fields in every cell, times the root of the cell's measure: (d, m, p), one layer per axis.

    With that weight the product of two of them is the integral ∫_e ∇u·∇w.
    """
    xp = namespace(mesh, fields)
    weighted = gradients(mesh) * xp.sqrt(measures(mesh))[:, None, None]
    corners = [gather(fields, mesh.cells[:, k]) for k in range(mesh.dimension + 1)]
    return xp.stack(
        [
            functools.reduce(operator.add, [weighted[:, k, axis, None] * corner for k, corner in enumerate(corners)])
            for axis in range(mesh.space_dimension)
        ]
    )
