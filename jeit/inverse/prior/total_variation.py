"""Total variation prior, for images that are piecewise constant: the penalty of an edge grows with its length and
height, not with its sharpness.

In a sheet, and in a solid with bounds, the image has one value per cell. The energy is λ Σ_f l_f √(d_f² + β²) over the
facets between cells, where d_f is the jump of the image across facet f and l_f is the facet's length divided by the
size of the body (3-D: its area divided by the squared size). It is not quadratic. Lagged diffusivity replaces it at
every iterate by the quadratic form ½ dᵀ diag(λ l_f / √(d_f² + β²)) d, which touches it there and lies above it
elsewhere. A step is then as cheap as with a smooth prior and lowers the energy itself. Vogel and Oman, SIAM J. Sci.
Comput. 17 (1996) 227-238; for EIT, Borsic, Graham, Adler and Lionheart, IEEE Trans. Med. Imaging 29 (2010) 44-54.

In a solid without bounds the image is linear between nodes, which are about a fifth as many as the cells. The energy is
λ/s² ∫ √(|∇x|² + (β/h)²) dV with the cell size h and the size s of the body. The quadratic form of lagged diffusivity is
then a stiffness matrix of the nodes.
"""

from __future__ import annotations

from typing import NoReturn

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.inverse.hyperparameter.choice import EDGE_PRICE
from jeit.inverse.prior.bases import DiagonalBasis, NodalBasis
from jeit.inverse.prior.nodal import factorise_matrix
from jeit.inverse.prior.penalties import AbstractPenalty, SparseNormal
from jeit.inverse.prior.priors import AbstractPrior, cell_factorisation, check_cells
from jeit.mesh import Mesh, gradients, measures
from jeit.mesh.geometry import interior_facets
from jeit_solvers import (
    Factor,
    FactorisationPlan,
    Fronts,
    SparsityPattern,
    analyse,
    factorise,
    find_fronts,
    solve,
    solve_definite,
)
from jeit_solvers.engines import gather, has_values, host, namespace, on_host, sum_into


class NodalTotalVariation(AbstractPenalty):
    """Penalty Σ weight √(|∇x|² + steepness²) + ½ Σ pull c² of the nodal image x = reference + c; further unknowns have
    a unit ridge penalty.

    **Fields**: `cells` (m, 4); `slope` (m, 4, 3): gradients of the basis functions, 1/m; `weight` (m,); `steepness`
    (m,): gradient below which the penalty is nearly quadratic, 1/m; `pull` (n,): weight of the deviation from the
    background; `reference` (n,); `pattern`, `plan`: sparsity pattern and factorisation plan of matrices over the nodes;
    `fronts`: order of the factorisation of matrices at hand.
    """

    cells: Int[Array, "m k"]
    slope: Float[Array, "m k d"]
    weight: Float[Array, " m"]
    steepness: Float[Array, " m"]
    pull: Float[Array, " n"]
    reference: Float[Array, " n"]
    pattern: SparsityPattern
    plan: FactorisationPlan
    fronts: Fronts = eqx.field(static=True)

    @classmethod
    def create(
        cls, mesh: Mesh, reference: Float[Array, " m"], hyperparameter, smoothing, pull: float
    ) -> tuple[NodalBasis, "NodalTotalVariation"]:
        """Create the nodal basis and the penalty for a mesh and a `reference` per cell; `pull` is relative to the
        hyperparameter."""
        mesh = on_host(mesh)
        cells, size = np.asarray(mesh.cells), mesh.num_points
        pattern = SparsityPattern.from_elements([cells], size=size)
        points = np.asarray(mesh.points)
        volume, extent = np.asarray(measures(mesh)), np.ptp(points, axis=0).max()
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
            plan=analyse(pattern, points),
            fronts=find_fronts(pattern, points),
        )
        return NodalBasis(energy.cells, size), energy

    @property
    def tolerance(self) -> float:
        """Relative change of the objective that ends a descent. It is larger than for other penalties, because lagged
        diffusivity converges linearly and its last steps do not change the image visibly."""
        return 1e-4

    def cost(self, coefficients):
        """Value of the penalty."""
        image, rest = self._parts(coefficients)
        edges = (self.weight * self._height(image)).sum()
        return edges + 0.5 * (self.pull * image**2).sum() + 0.5 * rest @ rest

    def diagonal(self, coefficients):
        """Diagonal of the quadratic form that touches the energy at c."""
        image, rest = self._parts(coefficients)
        own = (self.slope**2).sum(axis=-1) * (self.weight / self._height(image))[:, None]
        return jnp.concatenate([self.pull + sum_into(self.pull.shape, self.cells, own), jnp.ones_like(rest)])

    def inverse_hessian(self, coefficients, free, columns):
        """Approximate inverse of the energy's Hessian; its stiffness is the Hessian's along the gradient, which
        vanishes where the gradient is large."""
        image, _ = self._parts(coefficients)
        size = self.pull.shape[0]
        mine = free[:size]
        bend = self.weight * self.steepness**2 / self._height(image) ** 3
        within = gather(mine, self.cells)
        elements = self._elements(bend) * (within[:, :, None] & within[:, None, :])
        factor = factorise(self.plan, self._matrix(elements, jnp.where(mine, self.pull, 1)))
        solved = solve(self.plan, factor, columns[:size])
        return jnp.concatenate([solved, columns[size:]])

    def normal(self, coefficients):
        """Normal distribution whose precision is the quadratic form that touches the energy at c, as in
        `TotalVariationPenalty.normal`."""
        image, _ = self._parts(coefficients)
        values = self._matrix(self._elements(self.weight / self._height(image)), self.pull)
        return SparseNormal(self.pattern, self.plan, factorise(self.plan, values))

    def model(self, residual, jacobian, coefficients, data):
        """Objective and step: Gauss-Newton for the data, lagged diffusivity for the energy, in data space, as in
        `TotalVariationPenalty.model`."""
        image, rest = self._parts(coefficients)
        weighted = data.precision @ residual
        cost = 0.5 * residual @ weighted + self.cost(coefficients)
        stiffness = self.weight / self._height(image)
        size = image.shape[0]

        def step(damping):
            xp = namespace(self, jacobian)
            flux = stiffness[:, None] * self._gradient(self.reference + image)
            gradient = self.pull * image + self._divergence(flux)
            factor = factorise_matrix(self.plan, self.fronts, self._matrix(self._elements(stiffness), self.pull))
            columns = xp.concatenate([jacobian[:, :size].T, gradient[:, None]], axis=1)
            # Products with Γ are formed from half solves; the direction takes one more full solve.
            half = factor.half_solve(columns)
            products = half.T @ half
            further = jacobian[:, size:]
            outer = (products[:-1, :-1] + further @ further.T) / (1 + damping)
            descent = (products[:-1, -1] + further @ rest) / (1 + damping)
            inner = solve_definite(outer + data.covariance, residual - descent)
            image_direction = factor.solve((gradient + inner @ jacobian[:, :size])[:, None])[:, 0]
            direction = -xp.concatenate([image_direction, rest + inner @ further]) / (1 + damping)
            across = jacobian @ direction
            own, other = self._parts(direction)
            slope = weighted @ across + gradient @ own + rest @ other
            bend = (stiffness * (self._gradient(own) ** 2).sum(axis=1)).sum()
            bend = bend + (self.pull * own**2).sum() + other @ other
            return direction, slope, across @ data.precision @ across + bend

        return cost, step

    def _elements(self, stiffness):
        """Element matrices (m, k, k) of the quadratic form Σ stiffness |∇x|²."""
        return namespace(self, stiffness).einsum("mid,mjd,m->mij", self.slope, self.slope, stiffness)

    def _matrix(self, elements, diagonal):
        """Values of the matrix assembled from `elements`, plus `diagonal`."""
        values = self.pattern.assemble(elements)
        xp = namespace(self, values)
        return values + xp.concatenate([diagonal, xp.zeros(len(values) - len(diagonal))])

    def _gradient(self, image):
        """Gradient (m, d) of a nodal image in every cell, 1/m."""
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


# Weight of the deviation from the background relative to λ: it determines the image where the data do not.
_BACKGROUND_WEIGHT = 1e-3


class TotalVariation(AbstractPrior):
    """Total variation prior of `reconstruct`, for images that are piecewise constant.

    In a solid body the image is linear between nodes and a cell has the mean of its nodes; in a sheet every cell has
    its own value. The energy is not quadratic, so linear images and the rules that choose λ cannot use it; λ is a
    number, 300 by default.

    **Arguments:**

    - `smoothing`: β, the jump below which the penalty is nearly quadratic, on the link's scale (`Log()`: relative).

    Raises `ValueError` if the smoothing is not positive.

    **Example:**

    ```python
    image = reconstruct(model, voltages, 1.0, prior=TotalVariation())
    ```
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
        """Default λ, `EDGE_PRICE`."""
        return EDGE_PRICE

    def covariance_product(self, mesh, jacobian) -> NoReturn:
        """Not available. Raises `ValueError`."""
        _raise_not_quadratic("covariance")

    def precision(self, mesh, jacobian) -> NoReturn:
        """Not available. Raises `ValueError`."""
        _raise_not_quadratic("precision matrix")

    def basis(self, mesh, jacobian) -> NoReturn:
        """Not available. Raises `ValueError`."""
        _raise_not_quadratic("basis of independent shapes")

    def penalty(self, mesh, reference, hyperparameter, *, jacobian=None, regions=None, per_cell=False):
        """Basis with one coefficient per cell (or node of a solid), and the penalty weighted with λ. An edge as long as
        the body is wide has the penalty λ per unit of jump. Raises `ValueError` if `regions` are given."""
        if regions is not None:
            raise ValueError("regions: total variation finds its own; leave them out, or take another prior.")
        check_cells(mesh)
        if mesh.dimension == 3 and not per_cell and has_values(mesh):
            return NodalTotalVariation.create(mesh, reference, hyperparameter, self.smoothing, _BACKGROUND_WEIGHT)
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
            level=hyperparameter * _BACKGROUND_WEIGHT * area / area.sum(),
            smoothing=xp.asarray(self.smoothing),
            reference=reference,
            pattern=pattern,
            plan=plan,
            between_bounds=per_cell,
        )
        return DiagonalBasis(host.ones(mesh.num_cells)), penalty


def _raise_not_quadratic(what: str) -> NoReturn:
    raise ValueError(
        f"prior: total variation has no {what}, so there is no linear image with it; take reconstruct, or an Imager "
        "with gauss-newton or levenberg-marquardt, or another prior."
    )


class TotalVariationPenalty(AbstractPenalty):
    """Penalty Σ weight √(d² + β²) + ½ Σ level c², where d are the jumps of the image reference + c between neighbouring
    cells; further unknowns have a unit ridge penalty.

    **Fields**: `pairs` (f, 2): neighbouring cells; `weight` (f,): λ times relative length of the facets; `level` (m,):
    weight of the deviation from the background; `smoothing`: β; `reference` (m,): image at c = 0; `pattern`, `plan`:
    sparsity pattern and factorisation plan of matrices over the cells; `between_bounds`: whether the penalty is used by
    a solver that keeps bounds.
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
        """Relative change of the objective that ends a descent. It is larger than for other penalties, because lagged
        diffusivity converges linearly and its last steps do not change the image visibly."""
        return 1e-4

    def cost(self, coefficients):
        """Value of the penalty."""
        image, rest = self._parts(coefficients)
        edges = (self.weight * self._height(image)).sum()
        return edges + 0.5 * (self.level * image**2).sum() + 0.5 * rest @ rest

    def diagonal(self, coefficients):
        """Diagonal of the quadratic form that touches the energy at c."""
        image, rest = self._parts(coefficients)
        stiffness = self.weight / self._height(image)
        own = self.level.at[self.pairs[:, 0]].add(stiffness).at[self.pairs[:, 1]].add(stiffness)
        return jnp.concatenate([own, jnp.ones_like(rest)])

    def inverse_hessian(self, coefficients, free, columns):
        """Approximate inverse of the energy's Hessian, whose weights are β² / (d² + β²) times those of the touching
        quadratic form and vanish across large jumps."""
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
        """Normal distribution whose precision is the quadratic form that touches the energy at c. Each jump is normal
        with variance √(d² + β²) / weight, as if position and height of the edges were known. None with bounds."""
        if self.between_bounds:
            return None
        image, _ = self._parts(coefficients)
        return SparseNormal(self.pattern, self.plan, self._factor(self.weight / self._height(image)))

    def model(self, residual, jacobian, coefficients, data):
        """Objective and step: Gauss-Newton for the data, lagged diffusivity for the energy, in data space.

        The step is δ = -Γg - ΓJᵀ (JΓJᵀ + C)⁻¹ (r - JΓg), with the matrix Q of the touching quadratic form,
        Γ = Q⁻¹ / (1 + damping), and the gradient g of the energy.
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
        """Q⁻¹ times columns, for the touching quadratic form with weights `stiffness` of the squared jumps."""
        return solve(self.plan, self._factor(stiffness), columns)

    def _factor(self, stiffness) -> Factor:
        """Factorise Q for weights `stiffness` of the squared jumps."""
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
