"""The linear system of one mesh and kind of electrode: its sparsity pattern and the solver chosen for it."""

from __future__ import annotations

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
    """The sparsity pattern of the system matrix, and the lineax solver that solves with it.

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

    def grounded(
        self, mesh: Mesh, conductivity, electrodes: AbstractElectrodes, contact: Contact
    ) -> tuple[SparseSymmetric, Inexact[Array, "n c"]]:
        """The symmetric positive-definite matrix A of stiffness, contact mass and ground, (n, n) in siemens, and the
        loads of the electrodes, and of the ground where these are not points (n, L + 1).

        `conductivity` per cell, S/m (2-D: S).
        """
        nothing = (None,) * len(contact.mass)
        conducted = self.pattern.assemble(stiffness(mesh, conductivity), *nothing)
        ground = ground_conductance(self.pattern.diagonal(conducted), contact.load)
        values = conducted if electrodes.is_point else conducted + self.pattern.assemble(None, *contact.mass)
        values = values + namespace(values).concatenate([ground, np.zeros(len(values) - len(ground))])
        load = contact.load if electrodes.is_point else with_ground(contact.load, ground)
        return SparseSymmetric(values, self.pattern), load

    def solve(self, operator: SparseSymmetric, load: Inexact[Array, "n c"]) -> Inexact[Array, "n c"]:
        """A⁻¹ load, one column per load. Differentiable by the implicit rule, whichever solver."""
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

    def quadratic_form(self, operator: SparseSymmetric, load: Inexact[Array, "n c"]) -> Inexact[Array, "c c"]:
        """loadᵀ A⁻¹ load; half the work of `solve` where there is a factor."""
        load = load.astype(operator.values.dtype)
        if isinstance(self.solver, SparseCholesky):
            return quadratic_form(self.solver.plan, factorise(self.solver.plan, operator.values), load)
        return load.T @ self.solve(operator, load)


def ground_conductance(stiffness: Inexact[Array, " n"], load: Inexact[Array, "n L"]) -> Inexact[Array, " n"]:
    """A conductance (n,) to ground at one node under an electrode, of the order of the `stiffness` (n,) there.

    Currents that sum to zero send nothing through it, so it changes nothing; but the constant potential, which contacts
    that are all but open leave free, and point electrodes altogether, is fixed by it. Not differentiated.
    """
    xp = namespace(stiffness, load)
    stiffness = undifferentiated(abs(stiffness))
    node = xp.argmax(xp.where((undifferentiated(load) != 0).any(axis=1), stiffness, 0))
    return xp.where(np.arange(len(stiffness)) == node, stiffness, 0)


def with_ground(load: Inexact[Array, "n L"], ground: Inexact[Array, " n"]) -> Inexact[Array, "n c"]:
    """Loads of electrodes and, the last, of a `ground` (n,), (n, L + 1)."""
    return namespace(load, ground).concatenate([load, ground[:, None]], axis=1)
