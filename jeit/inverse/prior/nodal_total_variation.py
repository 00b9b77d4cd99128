"""Total variation of solid bodies: of images that are linear between nodes, a fifth as many as there are cells.

The energy λ ∫ √(|∇x|² + (β/h)²) dV, h the cell's size and lengths in units of the body's, is what
`jeit.inverse.prior.total_variation` sums over facets, and is lowered like it, by lagged diffusivity; but the quadratic
form that touches it is a stiffness matrix of the nodes.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.inverse.prior.bases import NodalBasis
from jeit.inverse.prior.nodal import in_columns
from jeit.inverse.prior.penalties import AbstractPenalty, SparseNormal
from jeit.mesh import Mesh, gradients, measures
from jeit_solvers import (
    Factor,
    FactorisationPlan,
    SparsityPattern,
    analyse,
    factorise,
    half_solve,
    solve,
    solve_definite,
)
from jeit_solvers.engines import gather, host, namespace, on_host, sum_into


class NodalTotalVariation(AbstractPenalty):
    """Σ weight √(|∇x|² + level²) + ½ Σ pull c², x being reference + c; with a unit ridge on further unknowns.

    **Fields**: `cells` (m, 4); `slope` (m, 4, 3), gradients of the basis functions, 1/m; `weight` (m,); `steepness`
    (m,), below which a slope costs by its square, 1/m; `pull` (n,) to the background; `reference` (n,); `pattern` and
    `plan` of matrices between nodes.
    """

    cells: Int[Array, "m k"]
    slope: Float[Array, "m k d"]
    weight: Float[Array, " m"]
    steepness: Float[Array, " m"]
    pull: Float[Array, " n"]
    reference: Float[Array, " n"]
    pattern: SparsityPattern
    plan: FactorisationPlan

    @classmethod
    def create(
        cls, mesh: Mesh, reference: Float[Array, " m"], hyperparameter, smoothing, pull: float
    ) -> tuple[NodalBasis, "NodalTotalVariation"]:
        """The basis of an image and its energy, for a mesh and a `reference` per cell; `pull` relative to an edge's
        price."""
        mesh = on_host(mesh)
        cells, size = np.asarray(mesh.cells), mesh.num_points
        pattern = SparsityPattern.from_elements([cells], size=size)
        plan = analyse(pattern, np.asarray(mesh.points))
        volume, extent = np.asarray(measures(mesh)), np.ptp(np.asarray(mesh.points), axis=0).max()
        share = np.repeat(volume[:, None] / cells.shape[1], cells.shape[1], axis=1)
        total = np.bincount(cells.ravel(), share.ravel(), size)
        xp = namespace(reference)
        onto_nodes = sum_into((size,), cells, xp.asarray(reference)[:, None] * share) / total
        energy = cls(
            cells=host.asarray(cells),
            slope=host.asarray(np.asarray(gradients(mesh))),
            weight=hyperparameter * host.asarray(volume / extent ** (mesh.dimension - 1)),
            steepness=smoothing / host.asarray(np.cbrt(volume)),
            pull=hyperparameter * host.asarray(pull * total / total.sum()),
            reference=onto_nodes,
            pattern=pattern,
            plan=plan,
        )
        return NodalBasis(energy.cells, size), energy

    @property
    def tolerance(self) -> float:
        """Relative change of the objective that ends a descent: lagged diffusivity converges linearly, and its last
        steps change nothing visible."""
        return 1e-4

    def cost(self, coefficients):
        """The energy."""
        image, rest = self._parts(coefficients)
        edges = (self.weight * self._height(image)).sum()
        return edges + 0.5 * (self.pull * image**2).sum() + 0.5 * rest @ rest

    def diagonal(self, coefficients):
        """Diagonal of the form that touches the energy at c."""
        image, rest = self._parts(coefficients)
        own = (self.slope**2).sum(axis=-1) * (self.weight / self._height(image))[:, None]
        return jnp.concatenate([self.pull + sum_into(self.pull.shape, self.cells, own), jnp.ones_like(rest)])

    def inverse_hessian(self, coefficients, free, columns):
        """Approximate inverse of the energy's own Hessian, which is zero across steep slopes."""
        image, _ = self._parts(coefficients)
        size = self.pull.shape[0]
        mine = free[:size]
        bend = self.weight * self.steepness**2 / self._height(image) ** 3
        within = gather(mine, self.cells)
        elements = self._elements(bend) * (within[:, :, None] & within[:, None, :])
        solved = solve(self.plan, self._factor(elements, jnp.where(mine, self.pull, 1)), columns[:size])
        return jnp.concatenate([solved, columns[size:]])

    def normal(self, coefficients):
        """Normal distribution of the form that touches the energy at c, as in `jeit.inverse.prior.total_variation`."""
        image, _ = self._parts(coefficients)
        factor = self._factor(self._elements(self.weight / self._height(image)), self.pull)
        return SparseNormal(self.pattern, self.plan, factor)

    def model(self, residual, jacobian, coefficients, data):
        """Gauss-Newton for the data, lagged diffusivity for the energy, in data space; as of
        `jeit.inverse.prior.total_variation`."""
        image, rest = self._parts(coefficients)
        weighted = data.precision @ residual
        cost = 0.5 * residual @ weighted + self.cost(coefficients)
        stiffness = self.weight / self._height(image)
        size = image.shape[0]

        def step(damping):
            xp = namespace(self, jacobian)
            flux = stiffness[:, None] * self._gradient(self.reference + image)
            gradient = self.pull * image + self._divergence(flux)
            factor = self._factor(self._elements(stiffness), self.pull)
            columns = xp.concatenate([jacobian[:, :size].T, gradient[:, None]], axis=1)
            # Products with Γ take half a solve each, and the direction is one more.
            half = in_columns(half_solve, self.plan, factor, columns)
            products = half.T @ half
            further = jacobian[:, size:]
            outer = (products[:-1, :-1] + further @ further.T) / (1 + damping)
            descent = (products[:-1, -1] + further @ rest) / (1 + damping)
            inner = solve_definite(outer + data.covariance, residual - descent)
            image_direction = solve(self.plan, factor, gradient + inner @ jacobian[:, :size])
            direction = -xp.concatenate([image_direction, rest + inner @ further]) / (1 + damping)
            across = jacobian @ direction
            own, other = self._parts(direction)
            slope = weighted @ across + gradient @ own + rest @ other
            bend = (stiffness * (self._gradient(own) ** 2).sum(axis=1)).sum()
            bend = bend + (self.pull * own**2).sum() + other @ other
            return direction, slope, across @ data.precision @ across + bend

        return cost, step

    def _elements(self, stiffness):
        """Element matrices of the form Σ stiffness |∇x|², (m, k, k)."""
        return namespace(self, stiffness).einsum("mid,mjd,m->mij", self.slope, self.slope, stiffness)

    def _factor(self, elements, diagonal) -> Factor:
        """Factorise form + diagonal."""
        values = self.pattern.assemble(elements)
        xp = namespace(self, values)
        return factorise(self.plan, values + xp.concatenate([diagonal, xp.zeros(len(values) - len(diagonal))]))

    def _gradient(self, image):
        """Gradient of an image of the nodes, in every cell, (m, d) 1/m."""
        return (self.slope * gather(image, self.cells)[:, :, None]).sum(axis=1)

    def _divergence(self, flux):
        """Adjoint of `_gradient`."""
        return sum_into(self.pull.shape, self.cells, (self.slope * flux[:, None]).sum(axis=-1))

    def _parts(self, coefficients):
        size = self.pull.shape[0]
        return coefficients[:size], coefficients[size:]

    def _height(self, image):
        squared = (self._gradient(self.reference + image) ** 2).sum(axis=1)
        return namespace(self, image).sqrt(squared + self.steepness**2)
