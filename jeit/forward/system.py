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
        if isinstance(self.solver, SparseCholesky):
            return _solve_directly(operator, load, self.solver)
        state = self.solver.init(operator, {})

        def column(vector):
            return lx.linear_solve(operator, vector, self.solver, state=state, throw=False).value

        return jax.vmap(column, in_axes=1, out_axes=1)(load)

    def quadratic_form(self, operator: SparseSymmetric, load: Inexact[Array, "n L"]) -> Inexact[Array, "L L"]:
        """loadᵀ A⁻¹ load; half the work of `solve` where there is a factor."""
        load = load.astype(operator.values.dtype)
        if isinstance(self.solver, SparseCholesky):
            return quadratic_form(self.solver.plan, self.solver.init(operator, {}), load)
        return load.T @ self.solve(operator, load)


@eqx.filter_custom_jvp
def _solve_directly(operator: SparseSymmetric, load, solver: SparseCholesky):
    """All columns at once, where lineax would take them one by one."""
    return solve(solver.plan, solver.init(operator, {}), load)


@_solve_directly.def_jvp
def _solve_directly_jvp(primals, tangents):
    operator, load, solver = primals
    factor = solver.init(operator, {})
    solution = solve(solver.plan, factor, load)
    values, right = tangents[0].values, tangents[1]
    source = jnp.zeros_like(load) if right is None else right
    if values is not None:  # A dX = dB - dA X
        source -= operator.pattern.multiply(values, solution)
    return solution, solve(solver.plan, factor, source)
