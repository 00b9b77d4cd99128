"""Total variation of conductivities of cells and of nodes.

Total variation of solid bodies: of images that are linear between nodes, a fifth as many as there are cells.

The energy λ ∫ √(|∇x|² + (β/h)²) dV, h the cell's size and lengths in units of the body's, is what
`jeit.inverse.prior.total_variation` sums over facets, and is lowered like it, by lagged diffusivity; but the quadratic
form that touches it is a stiffness matrix of the nodes.

Total variation: images of few pieces, whose edges cost by their length and height, not by their sharpness.

The energy λ Σ_f l_f √(d_f² + β²) over the facets between cells, l_f the facet's measure relative to the body's and d_f
the jump of the image across it, is not quadratic. Lagged diffusivity replaces it at every image by the quadratic form
that touches it there and lies above it everywhere else, ½ dᵀ diag(λ l_f / √(d_f² + β²)) d, so each step is as cheap as
a smooth prior's, and lowers the true cost. Vogel and Oman, SIAM J. Sci. Comput. 17 (1996) 227-238; for EIT, Borsic,
Graham, Adler and Lionheart, IEEE Trans. Med. Imaging 29 (2010) 44-54.
"""

from __future__ import annotations

from typing import NoReturn

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.inverse.hyperparameter.defaults import EDGE_PRICE
from jeit.inverse.prior.bases import DiagonalBasis, NodalBasis
from jeit.inverse.prior.nodal import in_columns
from jeit.inverse.prior.penalties import AbstractPenalty, SparseNormal
from jeit.inverse.prior.priors import AbstractPrior, cell_factorisation, check_cells
from jeit.mesh import Mesh, gradients, measures
from jeit.mesh.geometry import interior_facets
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
from jeit_solvers.engines import gather, has_values, host, namespace, on_host, sum_into


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


# Pull to the background, relative to the price of an edge: it determines the image where the data do not.
_LEVEL = 1e-3


class TotalVariation(AbstractPrior):
    """The prior of `reconstruct` for images of few pieces.

    In a solid body the image is linear between its nodes, and a cell has their mean; in a sheet every cell has its own.
    `smoothing` β: jumps below it, on the link's scale (`Log()`: relative), cost by their square. Its energy is not
    quadratic, so linear images and the rules that choose λ cannot use it: λ is a number, 300 unless given. Raises
    `ValueError` for a smoothing that is not positive.
    """

    smoothing: float = 0.01

    def __check_init__(self):
        if has_values(self.smoothing) and not (np.isfinite(self.smoothing) and self.smoothing > 0):
            raise ValueError(f"smoothing must be positive, on the link's scale; it is {self.smoothing}.")

    @property
    def is_quadratic(self) -> bool:
        """False."""
        return False

    @property
    def default_hyperparameter(self) -> float:
        """The price of an edge."""
        return EDGE_PRICE

    def covariance_product(self, mesh, jacobian) -> NoReturn:
        """Not available. Raises `ValueError`."""
        _refuse("covariance")

    def precision(self, mesh, jacobian) -> NoReturn:
        """Not available. Raises `ValueError`."""
        _refuse("precision matrix")

    def basis(self, mesh, jacobian) -> NoReturn:
        """Not available. Raises `ValueError`."""
        _refuse("basis of independent shapes")

    def penalty(self, mesh, reference, hyperparameter, *, jacobian=None, regions=None, per_cell=False):
        """Every cell on its own, and the energy, weighted with λ: what an edge as long as the body is wide costs per
        unit of jump. Raises `ValueError` for `regions`."""
        if regions is not None:
            raise ValueError("regions: total variation finds its own; leave them out, or take another prior.")
        check_cells(mesh)
        if mesh.dimension == 3 and not per_cell and has_values(mesh):
            return NodalTotalVariation.create(mesh, reference, hyperparameter, self.smoothing, _LEVEL)
        pairs, nodes = interior_facets(mesh)
        points = on_host(mesh.points)
        xp = namespace(points, hyperparameter, self.smoothing)
        corners = points[nodes]
        size = (points.max(axis=0) - points.min(axis=0)).max()
        if mesh.dimension == 2:
            length = xp.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
        else:
            cross = xp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            length = xp.linalg.norm(cross, axis=1) / 2
        pattern, plan = cell_factorisation(mesh, [pairs, np.arange(mesh.num_cells)[:, None]])
        area = on_host(measures(mesh))
        penalty = TotalVariationPenalty(
            pairs=host.asarray(pairs),
            weight=hyperparameter * length / size ** (mesh.dimension - 1),
            level=hyperparameter * _LEVEL * area / area.sum(),
            smoothing=xp.asarray(self.smoothing),
            reference=reference,
            pattern=pattern,
            plan=plan,
            between_bounds=per_cell,
        )
        return DiagonalBasis(host.ones(mesh.num_cells)), penalty


def _refuse(what: str) -> NoReturn:
    raise ValueError(
        f"prior: total variation has no {what}, so there is no linear image with it; take reconstruct, or an Imager "
        "with gauss-newton or levenberg-marquardt, or another prior."
    )


class TotalVariationPenalty(AbstractPenalty):
    """Σ weight √(d² + β²) + ½ Σ level c², d the jumps of reference + c; with a unit ridge on further unknowns.

    `between_bounds`: it is for solvers that keep bounds.
    """

    pairs: Int[Array, "f 2"]
    weight: Float[Array, " f"]
    level: Float[Array, " m"]
    smoothing: Float[Array, ""]
    reference: Float[Array, " m"]
    pattern: SparsityPattern
    plan: FactorisationPlan
    between_bounds: bool = eqx.field(static=True, default=False)

    @property
    def tolerance(self) -> float:
        """Relative change of the objective that ends a descent: lagged diffusivity converges linearly, and its last
        steps change nothing visible."""
        return 1e-4

    def cost(self, coefficients):
        """The energy."""
        image, rest = self._parts(coefficients)
        edges = (self.weight * self._height(image)).sum()
        return edges + 0.5 * (self.level * image**2).sum() + 0.5 * rest @ rest

    def diagonal(self, coefficients):
        """Diagonal of the form that touches the energy at c."""
        image, rest = self._parts(coefficients)
        stiffness = self.weight / self._height(image)
        own = self.level.at[self.pairs[:, 0]].add(stiffness).at[self.pairs[:, 1]].add(stiffness)
        return jnp.concatenate([own, jnp.ones_like(rest)])

    def inverse_hessian(self, coefficients, free, columns):
        """Approximate inverse of the energy's own Hessian, with β² / (d² + β²) of the touching form's weights: zero
        across high edges."""
        image, _ = self._parts(coefficients)
        mine = free[: self.level.shape[0]]
        bend = self.weight * self.smoothing**2 / self._height(image) ** 3
        both = mine[self.pairs[:, 0]], mine[self.pairs[:, 1]]
        own, across = [jnp.where(one, bend, 0) for one in both], jnp.where(both[0] & both[1], -bend, 0)
        link = jnp.stack([jnp.stack([own[0], across], axis=-1), jnp.stack([across, own[1]], axis=-1)], axis=-2)
        level = jnp.where(mine, self.level, 1)
        factor = factorise(self.plan, self.pattern.assemble(link, level[:, None, None]))
        image_columns, other = columns[: len(mine)], columns[len(mine) :]
        return jnp.concatenate([solve(self.plan, factor, image_columns), other])

    def normal(self, coefficients):
        """Normal distribution of the form that touches the energy at c: each jump is normal with variance √(d² + β²) /
        weight, as if where the edges are, and how high, were known. None between bounds."""
        if self.between_bounds:
            return None
        image, _ = self._parts(coefficients)
        return SparseNormal(self.pattern, self.plan, self._factor(self.weight / self._height(image)))

    def model(self, residual, jacobian, coefficients, data):
        """Gauss-Newton for the data, lagged diffusivity for the energy, in data space.

        With Q the touching quadratic form, g the gradient of the energy, and Γ = Q⁻¹ / (1 + damping),
        δ = -Γg - ΓJᵀ (JΓJᵀ + C)⁻¹ (r - JΓg).
        """
        image, rest = self._parts(coefficients)
        weighted = data.precision @ residual
        cost = 0.5 * residual @ weighted + self.cost(coefficients)
        stiffness = self.weight / self._height(image)

        def step(damping):
            xp = namespace(self, jacobian)
            flux = stiffness * self._jump(self.reference + image)
            gradient = self.level * image
            gradient = gradient + self._divergence(flux)
            size = image.shape[0]
            solved = self._solve(stiffness, xp.concatenate([jacobian[:, :size].T, gradient[:, None]], axis=1))
            product = xp.concatenate([solved[:, :-1], jacobian[:, size:].T]) / (1 + damping)
            descent = xp.concatenate([solved[:, -1], rest]) / (1 + damping)
            inner = solve_definite(jacobian @ product + data.covariance, residual - jacobian @ descent)
            direction = -descent - product @ inner
            across = jacobian @ direction
            own, other = self._parts(direction)
            slope = weighted @ across + gradient @ own + rest @ other
            bend = (stiffness * self._jump(own) ** 2).sum() + (self.level * own**2).sum() + other @ other
            return direction, slope, across @ data.precision @ across + bend

        return cost, step

    def _solve(self, stiffness, columns):
        """Q⁻¹ columns, Q the touching form of these weights of jumps."""
        return solve(self.plan, self._factor(stiffness), columns)

    def _factor(self, stiffness) -> Factor:
        """Factorise Q."""
        link = stiffness[:, None, None] * np.array([[1.0, -1.0], [-1.0, 1.0]])
        return factorise(self.plan, self.pattern.assemble(link, self.level[:, None, None]))

    def _divergence(self, flux):
        first, second = self.pairs[:, 0], self.pairs[:, 1]
        return sum_into(self.level.shape, first, flux) - sum_into(self.level.shape, second, flux)

    def _parts(self, coefficients):
        size = self.level.shape[0]
        return coefficients[:size], coefficients[size:]

    def _jump(self, image):
        return image[self.pairs[:, 0]] - image[self.pairs[:, 1]]

    def _height(self, image):
        return namespace(self, image).sqrt(self._jump(self.reference + image) ** 2 + self.smoothing**2)
