"""The finite-element system: assembly of the stiffness of the cells and of the contributions of the electrodes."""

from __future__ import annotations

import functools
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Inexact

from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrodes import Contact
from jeit.mesh import Mesh, gradients, measures, normals
from jeit_solvers import (
    ColumnSolver,
    ConjugateGradient,
    DirectSolver,
    Fronts,
    NumpySolver,
    SparseCholesky,
    SparseSymmetric,
    SparsityPattern,
    analyse,
    choose_solver,
    factorise,
    factorise_fronts,
    find_fronts,
    quadratic_form,
)
from jeit_solvers.engines import RecentResultsCache, gather, has_values, host, namespace, undifferentiated
from jeit_solvers.module import Module


def cell_conductivity(mesh: Mesh, conductivity) -> Inexact[Array, "m ..."]:
    """Conductivity per cell, (m,) or tensors (m, d, d), computed from values per cell, values per node, or tensors, in
    S/m (2-D: S).

    A conductivity given per node is linear in each cell. Because gradients of P1 functions are constant in a cell,
    replacing the conductivity by its mean over the cell's nodes is exact.
    """
    if conductivity.ndim == 1 and conductivity.shape[0] != mesh.num_cells:
        return gather(conductivity, mesh.cells).mean(axis=1)
    return conductivity


def check_conductivity(mesh: Mesh, conductivity) -> Inexact[Array, "..."]:
    """Convert `conductivity` to an array, and raise `ValueError` if the array has the wrong shape or is not positive.

    Accepts a scalar (converted to shape (m,)), values per cell (m,) or per node (n,), or symmetric tensors (m, s, s) in
    space of dimension s; in siemens per metre (in a 2-D sheet, siemens). Of tensors (m, 3, 3) on a surface in space,
    only the components in the plane of each triangle are used. A complex admittivity needs a positive real part. Values
    of traced arrays are not checked.
    """
    conductivity = np.asarray(conductivity) if has_values(conductivity) else jnp.asarray(conductivity)
    # All equivalent inputs get the same type and shape, because JAX compiles again for Python's "weakly typed" numbers.
    conductivity = namespace(conductivity).asarray(conductivity, dtype=_floating_type(conductivity.dtype))
    m, n, d = mesh.num_cells, mesh.num_points, mesh.space_dimension
    if conductivity.shape not in [(), (m,), (n,), (m, d, d)]:
        raise ValueError(
            f"conductivity has shape {conductivity.shape}; give a scalar, one value per cell ({m},), one per node "
            f"({n},), or tensors ({m}, {d}, {d}). For a batch, use jax.vmap."
        )
    if has_values(conductivity):
        _check_values(conductivity, np.asarray(normals(mesh)) if mesh.is_surface and has_values(mesh.points) else None)
    return namespace(conductivity).broadcast_to(conductivity, conductivity.shape or (m,))


def _floating_type(dtype: Any) -> Any:
    """Floating-point type for values of the given type. Raises `ValueError` for a type that is not numeric."""
    if dtype.kind in "OSUmM":
        raise ValueError(f"conductivity is {dtype}; give real or complex numbers, S/m (2-D: S).")
    if dtype.kind in "biu" or dtype.itemsize > 16 or (dtype.kind == "f" and dtype.itemsize > 8):
        return jnp.result_type(complex if dtype.kind == "c" else float)
    return jax.dtypes.canonicalize_dtype(dtype.newbyteorder("="))


def _check_values(conductivity: Any, normal: Any) -> None:
    if not np.isfinite(conductivity).all():
        raise ValueError("conductivity has NaN or infinite values.")
    if conductivity.ndim == 3:
        if not np.allclose(conductivity, np.swapaxes(conductivity, 1, 2), rtol=1e-12, atol=0):
            raise ValueError("conductivity tensors must be symmetric.")
        real_part = conductivity.real
        if normal is not None:  # tensors must be positive only within the surface: add a large value along its normal
            normal_projection = normal[:, :, None] * normal[:, None]
            projection = np.eye(3) - normal_projection
            real_part = projection @ real_part @ projection + np.abs(real_part).max() * normal_projection
        min_value = np.linalg.eigvalsh(real_part).min()
    else:
        min_value = conductivity.real.min()
    if min_value <= 0:
        raise ValueError(
            f"conductivity must be positive everywhere; its least value is {min_value:.3g}. For an insulating "
            "inclusion use a small positive value, such as a thousandth of the background."
        )


def cached_geometry(mesh: Mesh) -> tuple[Inexact[Array, "m k s"], Inexact[Array, " m"]]:
    """Gradients (m, d + 1, s) of the basis functions in m cells of dimension d in s-dimensional space, and measures
    (m,) of the cells. In NumPy, the results for the last mesh are cached."""
    return _last_geometry(mesh) if namespace(mesh) is np else _gradients_and_measures(mesh)


def _gradients_and_measures(mesh: Mesh):
    return gradients(mesh), measures(mesh)


_last_geometry = RecentResultsCache(_gradients_and_measures, 1)


def _unit_stiffness(mesh: Mesh) -> Inexact[Array, "p m"]:
    """Element stiffness matrices for unit conductivity, as defined in `stiffness`."""
    gradient, cell_measure = cached_geometry(mesh)
    return _scaled_stiffness(gradient, gradient, cell_measure)


def _scaled_stiffness(gradient, flux, weight) -> Inexact[Array, "p m"]:
    """Lower triangles (p, m) of the products of gradients and fluxes (m, k, s), multiplied by the weights (m,)."""
    xp, axes = namespace(gradient, flux, weight), range(gradient.shape[2])
    row_indices, column_indices = np.tril_indices(gradient.shape[1])
    return xp.stack(
        [
            weight * sum(gradient[:, row, axis] * flux[:, column, axis] for axis in axes)
            for row, column in zip(row_indices, column_indices, strict=True)
        ]
    )


_last_unit_stiffness = RecentResultsCache(_unit_stiffness, 1)


def stiffness(mesh: Mesh, conductivity: Inexact[Array, "m ..."]) -> Inexact[Array, "p m"]:
    """Element stiffness matrices ∫ ∇φ_i·σ∇φ_j of the basis functions φ, for a conductivity σ per cell in S/m (2-D: S).
    Returns lower triangles (p, m) in siemens, with p = (d+1)(d+2)/2 entries for each of m cells."""
    if conductivity.ndim == 1 and namespace(mesh, conductivity) is np:
        return conductivity * _last_unit_stiffness(mesh)
    gradient, cell_measure = cached_geometry(mesh)
    if conductivity.ndim == 1:
        return _scaled_stiffness(gradient, gradient, cell_measure * conductivity)
    return _scaled_stiffness(
        gradient, namespace(mesh, conductivity).einsum("mij,mkj->mki", conductivity, gradient), cell_measure
    )


def field_gradients(mesh: Mesh, fields: Inexact[Array, "n p"]) -> Inexact[Array, "d m p"]:
    """Gradients (d, m, p) of p nodal fields in each of m cells along d axes, multiplied by the square root of the
    cell's measure.

    With this weight the product of the gradients of two fields u, w is the integral ∫_e ∇u·∇w over the cell e.
    """
    xp = namespace(mesh, fields)
    gradient, cell_measure = cached_geometry(mesh)
    weighted_basis_gradients = gradient * xp.sqrt(cell_measure)[:, None, None]
    corners = [gather(fields, nodes) for nodes in mesh.cells.T]
    return xp.stack(
        [
            functools.reduce(
                operator.add, [weighted_basis_gradients[:, k, axis, None] * corner for k, corner in enumerate(corners)]
            )
            for axis in range(mesh.space_dimension)
        ]
    )


class System(Module):
    """Sparsity pattern of the system matrix, and the solvers of systems with this pattern.

    A system is created once for a mesh and a kind of electrode (`System.create`). It contains no physical quantities,
    so it is valid for every conductivity, contact impedance, electrode position and size.

    **Fields**: `pattern`: sparsity pattern; `solver`: lineax solver used in compiled programs; `fronts`: plan by which
    matrices with known values are factorised in NumPy, None if only `solver` is used.
    """

    pattern: SparsityPattern
    solver: lx.AbstractLinearSolver
    fronts: Fronts | None = eqx.field(static=True, default=None)

    @property
    def at_once(self) -> bool:
        """Whether matrices with known values are solved in NumPy."""
        return self.fronts is not None or isinstance(self.solver, NumpySolver)

    @classmethod
    def create(cls, mesh: Mesh, electrodes: AbstractElectrodes, solver: str | lx.AbstractLinearSolver = "auto"):
        """Create the system for a mesh and electrodes. `solver`: "auto" (chosen by predicted memory and time),
        "cholesky", "cg", or any lineax solver.

        Raises `ValueError` for an unknown name of a solver.
        """
        node_groups = [np.asarray(nodes) for nodes in (mesh.cells, *electrodes.contact_nodes(mesh))]
        pattern = SparsityPattern.from_elements(node_groups, size=mesh.num_points)
        if not isinstance(solver, str):
            return cls(pattern, solver)
        node_coordinates = np.asarray(mesh.points)
        if solver == "auto":
            fronts = find_fronts(pattern, node_coordinates)
            chosen_solver = choose_solver(pattern, node_coordinates)
            return cls(pattern, chosen_solver, fronts if isinstance(chosen_solver, DirectSolver) else None)
        if solver == "cholesky":
            return cls(pattern, SparseCholesky(analyse(pattern, node_coordinates)))
        if solver == "cg":
            return cls(pattern, ConjugateGradient())
        raise ValueError(f"solver must be 'auto', 'cholesky', 'cg' or a lineax solver, not '{solver}'.")

    def grounded_system(
        self, mesh: Mesh, conductivity, electrodes: AbstractElectrodes, contact: Contact
    ) -> tuple[SparseSymmetric, Inexact[Array, "n c"]]:
        """Return the system matrix A and the loads (right-hand sides). A, (n, n) in siemens, is symmetric positive
        definite, and the sum of stiffness, contact mass and ground. The loads of L electrodes are (n, L) for point
        electrodes, otherwise (n, L + 1) with the load of the ground.

        `conductivity` per cell, in S/m (2-D: S).
        """
        empty_contacts = (None,) * len(contact.mass)
        stiffness_values = self.pattern.assemble(stiffness(mesh, conductivity), *empty_contacts)
        ground_conductances = ground_conductance(self.pattern.diagonal(stiffness_values), contact.load)
        system_values = (
            stiffness_values if electrodes.is_point else stiffness_values + self.pattern.assemble(None, *contact.mass)
        )
        system_values = system_values + namespace(system_values).concatenate(
            [ground_conductances, np.zeros(len(system_values) - len(ground_conductances))]
        )
        load = contact.load if electrodes.is_point else append_ground(contact.load, ground_conductances)
        return SparseSymmetric(system_values, self.pattern), load

    def solve(self, operator: SparseSymmetric, load: Inexact[Array, "n c"]) -> Inexact[Array, "n c"]:
        """Solution A⁻¹ load for the matrix A of `operator`, one column per load. Differentiable by implicit
        differentiation, whichever solver is used."""
        load = load.astype(operator.values.dtype)
        if self.fronts is not None and isinstance(load, np.ndarray):
            solved_fields: Any = factorise_fronts(self.fronts, host.asarray(operator.values)).solve(load)
            return solved_fields.astype(load.dtype)
        if isinstance(self.solver, NumpySolver) and isinstance(load, np.ndarray):
            return self.solver.solve_columns(operator, load)
        constant_operator = jax.lax.stop_gradient(operator)  # derivatives come from A X = B, not from the factor of A
        solver_state: Any = self.solver.init(constant_operator, {})
        solver = self.solver
        if isinstance(solver, ColumnSolver):  # all columns at once; other lineax solvers solve for one column at a time

            def solve_columns(_, columns):
                return solver.solve_columns(solver_state, columns)

            def multiply(columns):
                return operator.pattern.multiply(operator.values, columns)

            return jax.lax.custom_linear_solve(multiply, load, solve_columns, symmetric=True)

        def column(vector):
            return lx.linear_solve(operator, vector, self.solver, state=solver_state, throw=False).value

        return jax.vmap(column, in_axes=1, out_axes=1)(load)

    def quadratic_form(self, operator: SparseSymmetric, load: Inexact[Array, "n c"]) -> Inexact[Array, "c c"]:
        """The product loadᵀ A⁻¹ load for the matrix A of `operator`. With a direct solver the product takes half the
        work of `solve`."""
        load = load.astype(operator.values.dtype)
        if self.fronts is not None and isinstance(load, np.ndarray):
            load_product: Any = factorise_fronts(self.fronts, host.asarray(operator.values)).quadratic_form(load)
            return load_product.astype(load.dtype)
        if isinstance(self.solver, SparseCholesky):
            return quadratic_form(self.solver.plan, factorise(self.solver.plan, operator.values), load)
        return load.T @ self.solve(operator, load)


def ground_conductance(stiffness: Inexact[Array, " n"], load: Inexact[Array, "n L"]) -> Inexact[Array, " n"]:
    """Conductances (n,) from the nodes to ground: zero except at one node under an electrode, where the conductance
    equals the `stiffness` (n,).

    If the electrode currents sum to zero, no current flows to ground, so the ground does not change the solution. The
    ground fixes the constant part of the potential, which is undetermined with point electrodes, and nearly so with
    complete electrodes of very large contact impedance. `load` (n, L): right-hand sides, nonzero under electrodes. The
    conductance is not differentiated.
    """
    xp = namespace(stiffness, load)
    stiffness = undifferentiated(abs(stiffness))
    node = xp.argmax(xp.where((undifferentiated(load) != 0).any(axis=1), stiffness, 0))
    return xp.where(np.arange(len(stiffness)) == node, stiffness, 0)


def append_ground(load: Inexact[Array, "n L"], ground_conductances: Inexact[Array, " n"]) -> Inexact[Array, "n c"]:
    """Loads (n, L + 1): the loads of the electrodes, followed by `ground_conductances` (n,)."""
    return namespace(load, ground_conductances).concatenate([load, ground_conductances[:, None]], axis=1)
