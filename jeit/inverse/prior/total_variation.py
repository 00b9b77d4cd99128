"""Total variation prior, for images that are piecewise constant: the penalty of an edge grows with the edge's length
and height, not with its sharpness.

In a sheet, and in a solid with bounds, the image has one value per cell. The energy is λ Σ_f l_f √(d_f² + β²) over the
facets between cells, where d_f is the jump of the image across facet f and l_f is the facet's length divided by the
size of the body (3-D: its area divided by the squared size). The energy is not quadratic. At every iterate, lagged
diffusivity replaces the energy by the quadratic form ½ dᵀ diag(λ l_f / √(d_f² + β²)) d, which touches the energy at the
iterate and lies above the energy elsewhere. A step is then as cheap as with a smooth prior and lowers the energy
itself. Vogel and Oman, SIAM J. Sci. Comput. 17 (1996) 227-238; for EIT, Borsic, Graham, Adler and Lionheart, IEEE
Trans. Med. Imaging 29 (2010) 44-54.

In a solid without bounds the image is linear between nodes. There are about a fifth as many nodes as cells. The energy
is λ/s² ∫ √(|∇x|² + (β/h)²) dV with the cell size h and the size s of the body. The quadratic form of lagged diffusivity
is then a stiffness matrix of the nodes.
"""

from __future__ import annotations

from typing import NoReturn

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.inverse.hyperparameter.choice import EDGE_HYPERPARAMETER_PENALTY
from jeit.inverse.prior.bases import DiagonalBasis, NodalBasis
from jeit.inverse.prior.linear_algebra import factorise_matrix
from jeit.inverse.prior.penalties import AbstractPenalty, SparsePrecisionNormal
from jeit.inverse.prior.priors import AbstractPrior, cell_factorisation, check_cells
from jeit.mesh import Mesh, gradients, measures
from jeit.mesh.mesh import interior_facets
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
    the penalty ½ ‖c‖².

    **Fields**: `cells` (m, 4): nodes of the cells; `slope` (m, 4, 3): gradients of the basis functions, 1/m; `weight`
    (m,): weight of each cell; `steepness` (m,): gradient below which the penalty is nearly quadratic, 1/m; `pull` (n,):
    weight of the deviation from the background; `reference` (n,): image at c = 0; `pattern`, `plan`: sparsity pattern
    and factorisation plan of matrices over the nodes; `fronts`: order of the factorisation of matrices with known
    values.
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
        cells, num_nodes = np.asarray(mesh.cells), mesh.num_points
        pattern = SparsityPattern.from_elements([cells], size=num_nodes)
        mesh_points = np.asarray(mesh.points)
        volume, body_size = np.asarray(measures(mesh)), np.ptp(mesh_points, axis=0).max()
        node_shares = np.repeat(volume[:, None] / cells.shape[1], cells.shape[1], axis=1)
        node_volumes = np.bincount(cells.ravel(), node_shares.ravel(), num_nodes)
        xp = namespace(reference)
        nodal_reference = sum_into((num_nodes,), cells, xp.asarray(reference)[:, None] * node_shares) / node_volumes
        penalty_energy = cls(
            cells=host.asarray(cells),
            slope=host.asarray(np.asarray(gradients(mesh))),
            weight=hyperparameter * host.asarray(volume / body_size ** (mesh.dimension - 1)),
            steepness=smoothing / host.asarray(np.cbrt(volume)),
            pull=hyperparameter * host.asarray(pull * node_volumes / node_volumes.sum()),
            reference=nodal_reference,
            pattern=pattern,
            plan=analyse(pattern, mesh_points),
            fronts=find_fronts(pattern, mesh_points),
        )
        return NodalBasis(penalty_energy.cells, num_nodes), penalty_energy

    @property
    def descent_tolerance(self) -> float:
        """Relative change of the objective that ends a descent. The tolerance is larger than for other penalties,
        because lagged diffusivity converges linearly and its last steps do not change the image visibly."""
        return 1e-4

    def cost(self, coefficients):
        """Value of the penalty at c."""
        image, unknowns = self._split_coefficients(coefficients)
        edge_cost = (self.weight * self._smoothed_height(image)).sum()
        return edge_cost + 0.5 * (self.pull * image**2).sum() + 0.5 * unknowns @ unknowns

    def diagonal(self, coefficients):
        """Diagonal of the quadratic form that touches the energy at c."""
        image, unknowns = self._split_coefficients(coefficients)
        node_stiffness = (self.slope**2).sum(axis=-1) * (self.weight / self._smoothed_height(image))[:, None]
        return jnp.concatenate(
            [self.pull + sum_into(self.pull.shape, self.cells, node_stiffness), jnp.ones_like(unknowns)]
        )

    def inverse_hessian(self, coefficients, free, columns):
        """Approximate inverse of the energy's Hessian, times columns. The stiffness is the second derivative of the
        energy along the gradient, which tends to zero where the gradient is large."""
        image, _ = self._split_coefficients(coefficients)
        num_nodes = self.pull.shape[0]
        is_free_node = free[:num_nodes]
        cell_curvature = self.weight * self.steepness**2 / self._smoothed_height(image) ** 3
        has_free_corner = gather(is_free_node, self.cells)
        element_matrices = self._element_matrices(cell_curvature) * (
            has_free_corner[:, :, None] & has_free_corner[:, None, :]
        )
        hessian_factor = factorise(
            self.plan, self._assembled_matrix(element_matrices, jnp.where(is_free_node, self.pull, 1))
        )
        image_columns = solve(self.plan, hessian_factor, columns[:num_nodes])
        return jnp.concatenate([image_columns, columns[num_nodes:]])

    def normal(self, coefficients):
        """Normal distribution whose precision is the quadratic form that touches the energy at c, as in
        `TotalVariationPenalty.normal`."""
        image, _ = self._split_coefficients(coefficients)
        matrix_values = self._assembled_matrix(
            self._element_matrices(self.weight / self._smoothed_height(image)), self.pull
        )
        return SparsePrecisionNormal(self.pattern, self.plan, factorise(self.plan, matrix_values))

    def model(self, residual, jacobian, coefficients, data):
        """Objective at c and the function that computes a step, as in `TotalVariationPenalty.model`."""
        image, unknowns = self._split_coefficients(coefficients)
        weighted_residual = data.precision @ residual
        objective_value = 0.5 * residual @ weighted_residual + self.cost(coefficients)
        stiffness = self.weight / self._smoothed_height(image)
        num_nodes = image.shape[0]

        def damped_step(damping):
            xp = namespace(self, jacobian)
            gradient_flux = stiffness[:, None] * self._image_gradient(self.reference + image)
            gradient = self.pull * image + self._divergence(gradient_flux)
            hessian_factor = factorise_matrix(
                self.plan, self.fronts, self._assembled_matrix(self._element_matrices(stiffness), self.pull)
            )
            right_sides = xp.concatenate([jacobian[:, :num_nodes].T, gradient[:, None]], axis=1)
            # Products of columns by way of Q⁻¹ are formed from half solves; the step requires one more full solve.
            half_solution = hessian_factor.half_solve(right_sides)
            solution_products = half_solution.T @ half_solution
            unknown_columns = jacobian[:, num_nodes:]
            data_covariance = (solution_products[:-1, :-1] + unknown_columns @ unknown_columns.T) / (1 + damping)
            predicted_residual = (solution_products[:-1, -1] + unknown_columns @ unknowns) / (1 + damping)
            dual_residual = solve_definite(data_covariance + data.covariance, residual - predicted_residual)
            image_direction = hessian_factor.solve((gradient + dual_residual @ jacobian[:, :num_nodes])[:, None])[:, 0]
            step_direction = -xp.concatenate([image_direction, unknowns + dual_residual @ unknown_columns]) / (
                1 + damping
            )
            data_change = jacobian @ step_direction
            image_change, unknown_change = self._split_coefficients(step_direction)
            cost_slope = weighted_residual @ data_change + gradient @ image_change + unknowns @ unknown_change
            penalty_curvature = (stiffness * (self._image_gradient(image_change) ** 2).sum(axis=1)).sum()
            penalty_curvature = (
                penalty_curvature + (self.pull * image_change**2).sum() + unknown_change @ unknown_change
            )
            return step_direction, cost_slope, data_change @ data.precision @ data_change + penalty_curvature

        return objective_value, damped_step

    def _element_matrices(self, stiffness):
        """Element matrices (m, k, k) of the quadratic form Σ stiffness |∇x|²."""
        return namespace(self, stiffness).einsum("mid,mjd,m->mij", self.slope, self.slope, stiffness)

    def _assembled_matrix(self, elements, diagonal):
        """Entries of the matrix assembled from `elements`, plus `diagonal`."""
        matrix_values = self.pattern.assemble(elements)
        xp = namespace(self, matrix_values)
        return matrix_values + xp.concatenate([diagonal, xp.zeros(len(matrix_values) - len(diagonal))])

    def _image_gradient(self, image):
        """Gradient (m, d) of a nodal image in every cell, 1/m."""
        return (self.slope * gather(image, self.cells)[:, :, None]).sum(axis=1)

    def _divergence(self, flux):
        """Adjoint of `_image_gradient`, applied to a `flux` in every cell."""
        return sum_into(self.pull.shape, self.cells, (self.slope * flux[:, None]).sum(axis=-1))

    def _split_coefficients(self, coefficients):
        """Coefficients of the image, and coefficients of further unknowns."""
        num_nodes = self.pull.shape[0]
        return coefficients[:num_nodes], coefficients[num_nodes:]

    def _smoothed_height(self, image):
        """Smoothed gradient √(|∇x|² + steepness²) of an image x per cell."""
        squared_gradient = (self._image_gradient(self.reference + image) ** 2).sum(axis=1)
        return namespace(self, image).sqrt(squared_gradient + self.steepness**2)


# Weight of the deviation from the background relative to λ. This term determines the image where the data do not.
_BACKGROUND_WEIGHT = 1e-3


class TotalVariation(AbstractPrior):
    """Total variation prior of `reconstruct`, for images that are piecewise constant.

    In a solid body the image is linear between nodes and a cell has the mean of its nodes; in a sheet every cell has
    its own value. The energy is not quadratic, so linear images and the rules that choose λ cannot use this prior; λ is
    a number, 300 by default.

    **Arguments:**

    - `smoothing`: β, the jump of the image below which the penalty is nearly quadratic, on the link's scale (`Log()`:
      relative change).

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
        """Whether the energy is quadratic: False."""
        return False

    @property
    def default_hyperparameter(self) -> float:
        """Default hyperparameter λ, `EDGE_HYPERPARAMETER_PENALTY`."""
        return EDGE_HYPERPARAMETER_PENALTY

    def covariance_product(self, mesh, jacobian) -> NoReturn:
        """Not available for this prior. Raises `ValueError`."""
        _raise_not_quadratic("covariance")

    def precision(self, mesh, jacobian) -> NoReturn:
        """Not available for this prior. Raises `ValueError`."""
        _raise_not_quadratic("precision matrix")

    def basis(self, mesh, jacobian) -> NoReturn:
        """Not available for this prior. Raises `ValueError`."""
        _raise_not_quadratic("basis of independent shapes")

    def penalty(self, mesh, reference, hyperparameter, *, jacobian=None, regions=None, per_cell=False):
        """Basis with one coefficient per cell (or node of a solid), and the total variation penalty weighted with λ. An
        edge as long as the body is wide has the penalty λ per unit of jump. Raises `ValueError` unless `regions` is
        None."""
        if regions is not None:
            raise ValueError("regions: total variation finds its own; leave them out, or take another prior.")
        check_cells(mesh)
        if mesh.dimension == 3 and not per_cell and has_values(mesh):
            return NodalTotalVariation.create(mesh, reference, hyperparameter, self.smoothing, _BACKGROUND_WEIGHT)
        cell_pairs, nodes = interior_facets(mesh)
        mesh_points = on_host(mesh.points)
        xp = namespace(mesh_points, hyperparameter, self.smoothing)
        corners = mesh_points[nodes]
        body_size = (mesh_points.max(axis=0) - mesh_points.min(axis=0)).max()
        if mesh.dimension == 2:
            facet_sizes = xp.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
        else:
            normals = xp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            facet_sizes = xp.linalg.norm(normals, axis=1) / 2
        pattern, elimination_plan = cell_factorisation(mesh, [cell_pairs, np.arange(mesh.num_cells)[:, None]])
        cell_measures = on_host(measures(mesh))
        penalty = TotalVariationPenalty(
            pairs=host.asarray(cell_pairs),
            weight=hyperparameter * facet_sizes / body_size ** (mesh.dimension - 1),
            level=hyperparameter * _BACKGROUND_WEIGHT * cell_measures / cell_measures.sum(),
            smoothing=xp.asarray(self.smoothing),
            reference=reference,
            pattern=pattern,
            plan=elimination_plan,
            between_bounds=per_cell,
        )
        return DiagonalBasis(host.ones(mesh.num_cells)), penalty


def _raise_not_quadratic(missing_quantity: str) -> NoReturn:
    raise ValueError(
        f"prior: total variation has no {missing_quantity}, so there is no linear image with it; take reconstruct, "
        "or an Imager with gauss-newton or levenberg-marquardt, or another prior."
    )


class TotalVariationPenalty(AbstractPenalty):
    """Penalty Σ weight √(d² + β²) + ½ Σ level c², where d are the jumps of the image reference + c between neighbouring
    cells; further unknowns have the penalty ½ ‖c‖².

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
    def descent_tolerance(self) -> float:
        """Relative change of the objective that ends a descent. The tolerance is larger than for other penalties,
        because lagged diffusivity converges linearly and its last steps do not change the image visibly."""
        return 1e-4

    def cost(self, coefficients):
        """Value of the penalty at c."""
        image, unknowns = self._split_coefficients(coefficients)
        edge_cost = (self.weight * self._smoothed_height(image)).sum()
        return edge_cost + 0.5 * (self.level * image**2).sum() + 0.5 * unknowns @ unknowns

    def diagonal(self, coefficients):
        """Diagonal of the quadratic form that touches the energy at c."""
        image, unknowns = self._split_coefficients(coefficients)
        stiffness = self.weight / self._smoothed_height(image)
        cell_stiffness = self.level.at[self.pairs[:, 0]].add(stiffness).at[self.pairs[:, 1]].add(stiffness)
        return jnp.concatenate([cell_stiffness, jnp.ones_like(unknowns)])

    def inverse_hessian(self, coefficients, free, columns):
        """Approximate inverse of the energy's Hessian, times columns. The weights in the Hessian are β² / (d² + β²)
        times the weights in the touching quadratic form and tend to zero across large jumps."""
        image, _ = self._split_coefficients(coefficients)
        is_free_cell = free[: self.level.shape[0]]
        facet_curvature = self.weight * self.smoothing**2 / self._smoothed_height(image) ** 3
        facet_is_free = is_free_cell[self.pairs[:, 0]], is_free_cell[self.pairs[:, 1]]
        diagonal_entries, coupling_entries = (
            [jnp.where(is_free_side, facet_curvature, 0) for is_free_side in facet_is_free],
            jnp.where(facet_is_free[0] & facet_is_free[1], -facet_curvature, 0),
        )
        facet_matrices = jnp.stack(
            [
                jnp.stack([diagonal_entries[0], coupling_entries], axis=-1),
                jnp.stack([coupling_entries, diagonal_entries[1]], axis=-1),
            ],
            axis=-2,
        )
        cell_level = jnp.where(is_free_cell, self.level, 1)
        hessian_factor = factorise(self.plan, self.pattern.assemble(facet_matrices, cell_level[:, None, None]))
        image_columns, unknown_columns = columns[: len(is_free_cell)], columns[len(is_free_cell) :]
        return jnp.concatenate([solve(self.plan, hessian_factor, image_columns), unknown_columns])

    def normal(self, coefficients):
        """Normal distribution whose precision is the quadratic form that touches the energy at c; None with bounds.
        Each jump is normal with variance √(d² + β²) / weight, as if position and height of the edges were known."""
        if self.between_bounds:
            return None
        image, _ = self._split_coefficients(coefficients)
        return SparsePrecisionNormal(
            self.pattern, self.plan, self._factorise_hessian(self.weight / self._smoothed_height(image))
        )

    def model(self, residual, jacobian, coefficients, data):
        """Objective at c and the function that computes a step in data space, by Gauss-Newton for the data and lagged
        diffusivity for the energy.

        The step is δ = -Γg - ΓJᵀ (JΓJᵀ + C)⁻¹ (r - JΓg), with the residual r and its Jacobian J, the covariance C of
        the data, the matrix Q of the touching quadratic form, Γ = Q⁻¹ / (1 + damping), and the gradient g of the
        energy.
        """
        image, unknowns = self._split_coefficients(coefficients)
        weighted_residual = data.precision @ residual
        objective_value = 0.5 * residual @ weighted_residual + self.cost(coefficients)
        stiffness = self.weight / self._smoothed_height(image)

        def damped_step(damping):
            xp = namespace(self, jacobian)
            jump_flux = stiffness * self._jump_across_facets(self.reference + image)
            gradient = self.level * image
            gradient = gradient + self._divergence(jump_flux)
            num_cells = image.shape[0]
            hessian_solutions = self._solve_hessian(
                stiffness, xp.concatenate([jacobian[:, :num_cells].T, gradient[:, None]], axis=1)
            )
            covariance_product = xp.concatenate([hessian_solutions[:, :-1], jacobian[:, num_cells:].T]) / (1 + damping)
            image_descent = xp.concatenate([hessian_solutions[:, -1], unknowns]) / (1 + damping)
            dual_residual = solve_definite(
                jacobian @ covariance_product + data.covariance, residual - jacobian @ image_descent
            )
            step_direction = -image_descent - covariance_product @ dual_residual
            data_change = jacobian @ step_direction
            image_change, unknown_change = self._split_coefficients(step_direction)
            cost_slope = weighted_residual @ data_change + gradient @ image_change + unknowns @ unknown_change
            penalty_curvature = (
                (stiffness * self._jump_across_facets(image_change) ** 2).sum()
                + (self.level * image_change**2).sum()
                + unknown_change @ unknown_change
            )
            return step_direction, cost_slope, data_change @ data.precision @ data_change + penalty_curvature

        return objective_value, damped_step

    def _solve_hessian(self, stiffness, columns):
        """Q⁻¹ times `columns`, where Q is the touching quadratic form with weights `stiffness` of the squared jumps."""
        return solve(self.plan, self._factorise_hessian(stiffness), columns)

    def _factorise_hessian(self, stiffness) -> Factor:
        """Factorise the touching quadratic form Q with weights `stiffness` of the squared jumps."""
        facet_matrices = stiffness[:, None, None] * np.array([[1.0, -1.0], [-1.0, 1.0]])
        return factorise(self.plan, self.pattern.assemble(facet_matrices, self.level[:, None, None]))

    def _divergence(self, flux):
        """Adjoint of `_jump_across_facets`, applied to a `flux` across every facet."""
        first_cells, second_cells = self.pairs[:, 0], self.pairs[:, 1]
        return sum_into(self.level.shape, first_cells, flux) - sum_into(self.level.shape, second_cells, flux)

    def _split_coefficients(self, coefficients):
        """Coefficients of the image, and coefficients of further unknowns."""
        num_cells = self.level.shape[0]
        return coefficients[:num_cells], coefficients[num_cells:]

    def _jump_across_facets(self, image):
        """Difference of the image across each facet."""
        return image[self.pairs[:, 0]] - image[self.pairs[:, 1]]

    def _smoothed_height(self, image):
        """Smoothed jump √(d² + β²) of an image across each facet."""
        return namespace(self, image).sqrt(self._jump_across_facets(self.reference + image) ** 2 + self.smoothing**2)
