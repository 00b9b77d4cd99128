"""The linear system of one mesh and kind of electrode: its sparsity pattern and the solver chosen for it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Inexact

from jeit.electrodes import AbstractElectrodes, Contact
from jeit.forward.assembly import stiffness
from jeit.mesh import Mesh
from jeit_solvers import (
    ConjugateGradient,
    SparseCholesky,
    SparseSymmetric,
    SparsityPattern,
    analyse,
    choose_solver,
    quadratic_form,
    solve,
)


class System(eqx.Module):
    """Where the entries of the system matrix go, and the lineax solver that solves with it.

    Made once for a mesh and a kind of electrode (`System.create`); holds no physics, so the same system serves
    every conductivity, contact impedance, electrode position and size.
    """

    pattern: SparsityPattern
    solver: lx.AbstractLinearSolver

    @classmethod
    def create(cls, mesh: Mesh, electrodes: AbstractElectrodes, solver: str | lx.AbstractLinearSolver = "auto"):
        """`solver`: "auto" (by predicted work and memory), "cholesky", "cg", or any lineax solver."""
        groups = [np.asarray(nodes) for nodes in (mesh.cells, *electrodes.contact_nodes(mesh))]
        pattern = SparsityPattern.from_elements(groups, size=mesh.num_points)
        if isinstance(solver, str):
            coordinates = np.asarray(mesh.points)
            if solver == "auto":
                solver = choose_solver(pattern, coordinates)
            elif solver == "cholesky":
                solver = SparseCholesky(analyse(pattern, coordinates))
            elif solver == "cg":
                solver = ConjugateGradient()
            else:
                raise ValueError(f"solver must be 'auto', 'cholesky', 'cg' or a lineax solver, not '{solver}'.")
        return cls(pattern, solver)

    def operator(self, mesh: Mesh, conductivity, electrodes: AbstractElectrodes, contact: Contact) -> SparseSymmetric:
        """The symmetric positive-definite matrix A of stiffness and contact mass, (n, n) in siemens.

        Point electrodes leave the constant potential free; a conductance to ground at node 0 fixes it. Currents
        that sum to zero send nothing through it, so its size does not matter: it is of the order of the rest.
        """
        packed = stiffness(mesh, conductivity)
        mass = contact.mass
        if electrodes.is_point:
            level = jax.lax.stop_gradient(jnp.abs(packed[-1]).mean())
            mass = (jnp.full((1, 1, 1), level, packed.dtype),)
        return SparseSymmetric(self.pattern.assemble(packed, *mass), self.pattern)

    def solve(self, operator: SparseSymmetric, load: Inexact[Array, "n L"]) -> Inexact[Array, "n L"]:
        """A⁻¹ load, one column per electrode. Differentiable by the implicit rule, whichever solver."""
        load = load.astype(operator.values.dtype)
        constant = jax.lax.stop_gradient(operator)  # derivatives come from A X = B alone, not through the factor
        state = self.solver.init(constant, {})
        if isinstance(self.solver, SparseCholesky):  # all columns at once, where lineax takes them one by one
            plan = self.solver.plan

            def solve_columns(_, columns):
                return solve(plan, state, columns)

            def multiply(columns):
                return operator.pattern.multiply(operator.values, columns)

            return jax.lax.custom_linear_solve(multiply, load, solve_columns, symmetric=True)

        def column(vector):
            return lx.linear_solve(operator, vector, self.solver, state=state, throw=False).value

        return jax.vmap(column, in_axes=1, out_axes=1)(load)

    def quadratic_form(self, operator: SparseSymmetric, load: Inexact[Array, "n L"]) -> Inexact[Array, "L L"]:
        """loadᵀ A⁻¹ load; half the work of `solve` where there is a factor."""
        load = load.astype(operator.values.dtype)
        if isinstance(self.solver, SparseCholesky):
            return quadratic_form(self.solver.plan, self.solver.init(operator, {}), load)
        return load.T @ self.solve(operator, load)
