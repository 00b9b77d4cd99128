"""The linear system of one mesh and kind of electrode: its sparsity pattern and the solver chosen for it."""

import equinox as eqx
import jax
import lineax as lx
import numpy as np
from jaxtyping import Array, Inexact

from jeit.electrodes import AbstractElectrodes
from jeit.electrodes.electrodes import Contact
from jeit.forward.assembly import stiffness
from jeit.mesh import Mesh
from jeit_solvers import (
    ConjugateGradient,
    SparseCholesky,
    SparseSymmetric,
    SparsityPattern,
    analyse,
    choose_solver,
    factorise,
    quadratic_form,
    solve,
)
from jeit_solvers.engines import namespace, undifferentiated


class System(eqx.Module):
    """Where the entries of the system matrix go, and the lineax solver that solves with it.

    Made once for a mesh and a kind of electrode (`System.create`); holds no physics, so the same system serves
    every conductivity, contact impedance, electrode position and size.
    """

    pattern: SparsityPattern
    solver: lx.AbstractLinearSolver

    @classmethod
    def create(cls, mesh: Mesh, electrodes: AbstractElectrodes, solver: str | lx.AbstractLinearSolver = "auto"):
        """`solver`: "auto" (by predicted work and memory), "cholesky", "cg", or any lineax solver.

        Raises `ValueError` for another name.
        """
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

        `conductivity` per cell, S/m (2-D: S).
        """
        packed = stiffness(mesh, conductivity)
        mass = grounded_mass(electrodes, contact, packed)
        return SparseSymmetric(self.pattern.assemble(packed, *mass), self.pattern)

    def solve(self, operator: SparseSymmetric, load: Inexact[Array, "n L"]) -> Inexact[Array, "n L"]:
        """A⁻¹ load, one column per electrode. Differentiable by the implicit rule, whichever solver."""
        load = load.astype(operator.values.dtype)
        if isinstance(self.solver, SparseCholesky) and isinstance(load, np.ndarray):
            return solve(self.solver.plan, factorise(self.solver.plan, operator.values), load)
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
            return quadratic_form(self.solver.plan, factorise(self.solver.plan, operator.values), load)
        return load.T @ self.solve(operator, load)


def grounded_mass(electrodes: AbstractElectrodes, contact: Contact, packed) -> tuple[Inexact[Array, "q k k"], ...]:
    """Contact mass of the electrodes; or for point electrodes, which leave the constant potential free, a conductance
    to ground at node 0 that fixes it. Currents that sum to zero send nothing through it, so its size does not matter:
    it is of the order of the `packed` stiffness."""
    if not electrodes.is_point:
        return contact.mass
    level = undifferentiated(abs(packed[-1]).mean())
    return (namespace(packed).full((1, 1, 1), level, packed.dtype),)
