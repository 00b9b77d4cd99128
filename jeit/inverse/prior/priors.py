"""Priors of conductivity: quadratic energies xᵀQx of an image x, with precision matrix Q.

A linear image minimises ‖W^½ (J x - v)‖² + λ² xᵀQx. With M measurements and m ≫ M cells the image is computed in data
space, which requires only products of the prior covariance Γ = Q⁻¹ with Jᵀ. If Q has a null space (Laplace: constant
images), Γ is any generalised inverse of Q, and the component in the null space is estimated from the data without
penalty.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.spatial.distance import cdist

from jeit.arguments import check_has_values, check_kind
from jeit.inverse.hyperparameter.choice import DEFAULT_RULE
from jeit.inverse.prior.bases import AbstractBasis, DenseBasis, DiagonalBasis, Regions
from jeit.inverse.prior.linear_algebra import (
    GriddedGaussian,
    NodalSystem,
    apply_to_columns,
    pivoted_cholesky,
    traced_pivoted_cholesky,
)
from jeit.inverse.prior.penalties import (
    AbstractPenalty,
    QuadraticForm,
    Ridge,
)
from jeit.mesh import Mesh, centroids
from jeit.mesh.mesh import interior_facets
from jeit_solvers import (
    FactorisationPlan,
    SparsityPattern,
    analyse,
    factorise,
    solve,
)
from jeit_solvers.engines import has_values, host, on_host
from jeit_solvers.module import Module

_PRIOR_EXAMPLES = (
    "an object of jeit.inverse: Noser(), Gaussian(length in metres), Laplace(), Tikhonov(), TotalVariation()"
)


def check_prior(prior: Any) -> None:
    """Raise `ValueError` unless `prior` is a prior object. Names of priors are accepted only by the command line and
    `ImagingSettings`."""
    check_kind("prior", prior, AbstractPrior, _PRIOR_EXAMPLES)


# Number of rows of a dense covariance computed at a time.
_ROWS_AT_ONCE = 512
# Fraction of a Gaussian prior's variance that the shapes of its basis may leave out.
_MAX_OMITTED_VARIANCE = 1e-3
# Maximum number of shapes of the basis.
_MAX_BASIS_SHAPES = 2000
# Number of cells above which images consist only of shapes that the data resolve, and the Laplace prior couples nodes
# in place of cells.
_LARGE_MESH_CELLS = 30_000
# Squared signal of a shape, relative to the largest, below which the data do not resolve the shape.
_MIN_SQUARED_SIGNAL = 1e-12
# Term added to the diagonal of a precision matrix that has constant images in its null space.
_RELATIVE_DIAGONAL_TERM = 1e-6


class AbstractPrior(Module):
    """Base of all priors on an image of one value per cell.

    A new quadratic prior is a subclass with `covariance_product`, `precision` and `basis`. A prior whose energy is not
    xᵀQx overrides `penalty` and raises `ValueError` in methods that do not apply to such a prior. Real and imaginary
    part of a complex image have the same prior; methods are called with the complex conjugate of a complex Jacobian.

    **Example:**

    ```python
    isinstance(Matern(0.05), AbstractPrior), Matern(0.05).is_quadratic
    ```
    """

    @property
    def is_quadratic(self) -> bool:
        """Whether the energy is xᵀQx, as linear images, rules for λ and an `Imager` with memory require."""
        return True

    @property
    def default_hyperparameter(self) -> float | str:
        """Default λ of `reconstruct`, or the name of the rule that chooses it."""
        return DEFAULT_RULE

    def penalty(
        self,
        mesh: Mesh,
        reference: Float[Array, " m"],
        hyperparameter: ArrayLike,
        *,
        jacobian: Float[Array, "M m"] | None = None,
        regions: Regions | None = None,
        per_cell: bool = False,
    ) -> tuple[AbstractBasis, AbstractPenalty]:
        """Basis S of an image x = `reference` + S c, and the penalty of its coefficients c, weighted with λ.

        `jacobian`: Jacobian of the whitened data with respect to the link's variable. `regions`: regions of cells that
        share a value. `per_cell`: whether every coefficient must be the value of a cell, as bounds require. Raises
        `ValueError` for invalid or inconsistent arguments.
        """
        assert jacobian is not None  # a quadratic prior may depend on it
        if not per_cell:
            is_large_mesh = mesh.num_cells > _LARGE_MESH_CELLS and has_values(mesh, jacobian, self)
            basis = (self.informed_basis if is_large_mesh else self.basis)(mesh, jacobian).scaled(1 / hyperparameter)
            return basis if regions is None else basis.pooled(regions), Ridge()
        if regions is not None:
            raise ValueError("regions: bounded solvers take every cell; use link=Bounded(lower, upper) instead.")
        quadratic_form = QuadraticForm.create(*self.entries(mesh, jacobian), hyperparameter, mesh.num_cells)
        return DiagonalBasis(host.ones(mesh.num_cells)), quadratic_form

    @abc.abstractmethod
    def covariance_product(self, mesh: Mesh, jacobian: Float[Array, "M m"]) -> Float[Array, "m M"]:
        """Product Γ Jᵀ of the prior covariance with the transposed Jacobian, one column per measurement."""

    @abc.abstractmethod
    def precision(self, mesh: Mesh, jacobian: Float[Array, "M m"]) -> scipy.sparse.sparray:
        """Precision matrix Q (m, m), sparse."""

    def entries(self, mesh: Mesh, jacobian: Float[Array, "M m"]) -> tuple[Any, Any, Any]:
        """Rows, columns and values of the k nonzero entries of the precision matrix Q, (k,) each."""
        precision_matrix = scipy.sparse.coo_array(self.precision(mesh, jacobian))
        return precision_matrix.row, precision_matrix.col, precision_matrix.data

    @abc.abstractmethod
    def basis(self, mesh: Mesh, jacobian: Float[Array, "M m"]) -> AbstractBasis:
        """Basis S with Γ = S Sᵀ, for nonlinear reconstruction. If Q has a null space, images in it have a large but
        finite variance."""

    def informed_basis(self, mesh: Mesh, jacobian: Float[Array, "M m"]) -> AbstractBasis:
        """Basis with fewer shapes that replaces S on meshes of many cells; see `informed_shapes`."""
        return self.basis(mesh, jacobian)

    def null_space(self, mesh: Mesh) -> Float[Array, "m p"]:
        """Basis (m, p) of the images of zero energy; empty by default."""
        return host.zeros((mesh.num_cells, 0))


class Tikhonov(AbstractPrior):
    """Zeroth-order Tikhonov prior, Q = I: cells are independent, and deviations from the background are penalised.

    **Example:**

    ```python
    image = one_step(model, 1.0, prior=Tikhonov(), hyperparameter=0.01).image(change)
    ```
    """

    def covariance_product(self, mesh, jacobian):
        """Product Γ Jᵀ = Jᵀ, because Γ = I."""
        return jacobian.T

    def precision(self, mesh, jacobian) -> scipy.sparse.sparray:
        """Precision matrix Q, the identity matrix."""
        return scipy.sparse.csr_array(scipy.sparse.eye_array(mesh.num_cells))

    def basis(self, mesh, jacobian):
        """Diagonal basis with one coefficient per cell."""
        return DiagonalBasis(host.ones(mesh.num_cells))


class Noser(AbstractPrior):
    """NOSER prior, Q = diag(JᵀJ)^exponent, which balances the sensitivity between the edge and the centre.

    Cheney, Isaacson, Newell, Simske and Goble, Int. J. Imaging Syst. Technol. 2 (1990) 66-75.

    **Arguments:**

    - `exponent`: with 1, every cell is weighted with its squared sensitivity; 0 is equivalent to `Tikhonov`.

    **Example:**

    ```python
    image = one_step(model, 1.0, prior=Noser(0.5), hyperparameter=0.1).image(change)
    ```
    """

    exponent: float = 0.5

    def covariance_product(self, mesh, jacobian):
        """Product Γ Jᵀ: Jᵀ with its rows divided by the diagonal of Q."""
        return jacobian.T / (abs(jacobian) ** 2).sum(axis=0)[:, None] ** self.exponent

    def precision(self, mesh, jacobian):
        """Precision matrix Q, a diagonal matrix."""
        return scipy.sparse.diags_array(np.asarray(self.entries(mesh, jacobian)[2])).tocsr()

    def entries(self, mesh, jacobian):
        """Entries on the diagonal of Q, differentiable with respect to the Jacobian."""
        cells = host.arange(mesh.num_cells)
        return cells, cells, (abs(jacobian) ** 2).sum(axis=0) ** self.exponent

    def basis(self, mesh, jacobian):
        """Diagonal basis with one coefficient per cell."""
        return DiagonalBasis((abs(jacobian) ** 2).sum(axis=0) ** (-self.exponent / 2))


class Laplace(AbstractPrior):
    """Laplace prior, a smoothness prior: xᵀQx = 2 Σ (x_i - x_j)² over cells that share a facet, so Q is twice the graph
    Laplacian.

    Differences are not weighted by geometry, as is usual in EIT, and a constant image has no penalty. In a solid body
    of more than 30,000 cells, where the factor of Q would be too large, differences are taken between nodes that share
    an edge, and a cell has the mean of its nodes.

    **Example:**

    ```python
    image = one_step(model, 1.0, prior=Laplace(), hyperparameter=0.01, noise=1e-4).image(change)
    ```
    """

    def covariance_product(self, mesh, jacobian):
        """Product Γ Jᵀ, where Γ is the generalised inverse of Q with the value of cell 0, or node 0, set to zero."""
        check_cells(mesh)
        if mesh.dimension == 3 and mesh.num_cells > _LARGE_MESH_CELLS and has_values(mesh, jacobian):
            return host.asarray(_node_covariance_product(mesh, np.asarray(jacobian).T, 0.0))
        cell_pairs, _ = interior_facets(mesh)
        pattern, elimination_plan = on_host(cell_factorisation(mesh, [cell_pairs, np.zeros((1, 1), int)]))
        link_matrices = host.broadcast_to(np.array([[2.0, -2.0], [-2.0, 2.0]]), (len(cell_pairs), 2, 2))
        precision_factor = factorise(elimination_plan, pattern.assemble(link_matrices, np.full((1, 1, 1), 2.0)))
        jacobian_columns = on_host(jacobian).T
        if not np.iscomplexobj(jacobian_columns):
            return solve(elimination_plan, precision_factor, jacobian_columns)
        return solve(elimination_plan, precision_factor, jacobian_columns.real) + 1j * solve(
            elimination_plan, precision_factor, jacobian_columns.imag
        )

    def precision(self, mesh, jacobian):
        """Precision matrix Q, twice the graph Laplacian."""
        check_cells(mesh)
        cell_pairs, _ = interior_facets(mesh)
        num_cells = mesh.num_cells
        adjacency = scipy.sparse.coo_array((np.ones(len(cell_pairs)), cell_pairs.T), shape=(num_cells, num_cells))
        adjacency_matrix = (adjacency + adjacency.T).tocsr()
        return (
            2 * (scipy.sparse.diags_array(np.asarray(adjacency_matrix.sum(axis=1)).ravel()) - adjacency_matrix).tocsr()
        )

    def basis(self, mesh, jacobian):
        """Dense basis from a Cholesky factor of Q, with a very small penalty on constant images."""
        precision = self.precision(mesh, jacobian).toarray()
        precision[np.diag_indices_from(precision)] += _RELATIVE_DIAGONAL_TERM
        lower_factor = scipy.linalg.cholesky(precision, lower=True)
        return DenseBasis(scipy.linalg.solve_triangular(lower_factor, np.eye(len(lower_factor)), lower=True).T)

    def informed_basis(self, mesh, jacobian):
        """Basis of the shapes that the data resolve (`informed_shapes`) in a solid, with a very small penalty on
        constant images; in a sheet, `basis`."""
        if mesh.dimension != 3:
            return self.basis(mesh, jacobian)
        covariance_product = partial(_node_covariance_product, mesh, degrees_of_freedom=_RELATIVE_DIAGONAL_TERM)
        return informed_shapes(np.asarray(jacobian), covariance_product, None)

    def null_space(self, mesh):
        """Basis (m, 1) of the images of zero energy: the constant image."""
        return host.ones((mesh.num_cells, 1))


class Gaussian(AbstractPrior):
    """Gaussian prior: a smooth random field with covariance Γ_ij = exp(-|x_i - x_j|² / 2 length²) between cell centres.
    The field does not depend on the mesh.

    **Arguments:**

    - `length`: correlation length in metres.

    Raises `ValueError` if the length is not positive.

    **Example:**

    ```python
    image = one_step(model, 1.0, prior=Gaussian(0.02), hyperparameter=0.01, noise=1e-4).image(change)
    ```
    """

    length: float

    def __check_init__(self):
        if has_values(self.length) and not self.length > 0:
            raise ValueError(f"length must be positive, in metres; it is {self.length}.")

    def covariance_product(self, mesh, jacobian):
        """Product Γ Jᵀ, computed in blocks of rows so that the dense Γ is never stored, or on a grid if there are many
        cells."""
        scaled_centres = centroids(mesh) / (np.sqrt(2) * self.length)
        if not has_values(scaled_centres, jacobian):
            return _traced_product(jnp.asarray(scaled_centres), jnp.asarray(jacobian))
        if mesh.num_cells > _LARGE_MESH_CELLS and GriddedGaussian.is_efficient(
            centres := np.asarray(centroids(mesh)), float(self.length)
        ):
            return host.asarray(GriddedGaussian(centres, float(self.length)).product(np.asarray(jacobian).T))
        scaled_centres = np.asarray(scaled_centres)
        centre_blocks = np.split(scaled_centres, np.arange(_ROWS_AT_ONCE, len(scaled_centres), _ROWS_AT_ONCE))
        return host.concatenate(
            [np.exp(-cdist(row, scaled_centres, "sqeuclidean")) @ np.asarray(jacobian).T for row in centre_blocks]
        )

    def basis(self, mesh, jacobian):
        """Basis of shapes that represent all but a thousandth of the variance. There are fewer shapes than cells if
        `length` spans many cells.

        If the length or the mesh's points are traced, the basis is padded with zero shapes; the image is the same.
        """
        centres = centroids(mesh)
        if not has_values(centres, self.length):
            scaled_centres = jnp.asarray(centres) / (np.sqrt(2) * self.length)
            return DenseBasis(
                traced_pivoted_cholesky(scaled_centres, tolerance=_MAX_OMITTED_VARIANCE, max_rank=_MAX_BASIS_SHAPES)
            )
        centres = np.asarray(centres)

        def column(cell):
            return np.exp(-np.sum((centres - centres[cell]) ** 2, axis=1) / (2 * self.length**2))

        unit_variances = np.ones(len(centres))
        return DenseBasis(
            host.asarray(
                pivoted_cholesky(unit_variances, column, tolerance=_MAX_OMITTED_VARIANCE, max_rank=_MAX_BASIS_SHAPES)
            )
        )

    def informed_basis(self, mesh, jacobian):
        """Basis of the shapes that the data resolve (`informed_shapes`), computed on a grid; `basis` if the grid would
        be too large."""
        centres = np.asarray(centroids(mesh))
        if not GriddedGaussian.is_efficient(centres, float(self.length)):
            return self.basis(mesh, jacobian)
        gridded_covariance = GriddedGaussian(centres, float(self.length))
        return informed_shapes(np.asarray(jacobian), gridded_covariance.product, gridded_covariance.variance)

    def precision(self, mesh, jacobian):
        """Not available: the inverse of a Gaussian covariance is dense and ill-conditioned. Raises `ValueError`."""
        raise ValueError(
            "prior: Gaussian has no usable precision matrix, which bounds need; take Noser, Tikhonov, Laplace or "
            "TotalVariation, or link=Bounded(lower, upper) in place of bounds."
        )


def informed_shapes(
    jacobian: Float[np.ndarray, "M m"],
    covariance: Callable[[Float[np.ndarray, "m M"]], Any],
    variance: Float[np.ndarray, " m"] | None,
) -> DenseBasis:
    """Basis of the shapes that data with Jacobian J resolve under the prior covariance Γ, ΓJᵀ(JΓJᵀ)^-½. There are at
    most as many shapes as data.

    `covariance`: function that multiplies an array by Γ; `variance`: diagonal of Γ, if known. Shapes are stored in
    single precision, which changes an image by a relative 1e-6.
    """
    covariance_product = np.asarray(covariance(jacobian.T))
    data_covariance = jacobian @ covariance_product
    eigenvalues, data_eigenvectors = np.linalg.eigh((data_covariance + data_covariance.T) / 2)
    is_informed_direction = eigenvalues > _MIN_SQUARED_SIGNAL * eigenvalues[-1]
    image_shapes = (
        covariance_product @ (data_eigenvectors[:, is_informed_direction] / np.sqrt(eigenvalues[is_informed_direction]))
    ).astype(np.float32)
    if variance is None:
        return DenseBasis(host.asarray(image_shapes))
    shape_variance = np.einsum("mn,mn->m", image_shapes, image_shapes)
    return DenseBasis(host.asarray(image_shapes), host.asarray(np.maximum(variance - shape_variance, 0)))


def _node_covariance_product(
    mesh: Mesh, columns: Float[np.ndarray, "m k"], degrees_of_freedom: float
) -> Float[np.ndarray, "m k"]:
    """Product of Γ with `columns`, where Γ is the inverse of twice the graph Laplacian of nodes that share an edge,
    averaged over cells. `degrees_of_freedom` is added to the Laplacian's diagonal; if `degrees_of_freedom` is 0, the
    value of node 0 is set to zero."""
    system = NodalSystem.create(mesh)
    neighbour_matrix = system.pattern.to_scipy(np.ones(system.pattern.num_entries))
    diagonal = 2 * (np.asarray(neighbour_matrix.sum(axis=1)).ravel() - 1) + degrees_of_freedom
    if not degrees_of_freedom:
        diagonal[0] += 2
    matrix_values = np.full(system.pattern.num_entries, -2.0)
    matrix_values[: len(diagonal)] = diagonal
    mean_matrix, solve_system = system.means, system.inverse(matrix_values)
    return apply_to_columns(
        lambda column_block: mean_matrix @ solve_system(mean_matrix.T @ column_block), columns, mesh.num_cells
    )


@jax.jit
def _traced_product(scaled_centres, jacobian):
    """Product Γ Jᵀ from cell centres divided by √2 length, in blocks of rows. Derivatives recompute the blocks to save
    memory."""

    @jax.checkpoint
    def covariance_rows(centre_block):
        return jnp.exp(-((centre_block[:, None] - scaled_centres) ** 2).sum(axis=-1)) @ jacobian.T

    num_padding_rows = -len(scaled_centres) % _ROWS_AT_ONCE
    centre_blocks = jnp.pad(scaled_centres, ((0, num_padding_rows), (0, 0))).reshape(
        -1, _ROWS_AT_ONCE, scaled_centres.shape[1]
    )
    return jax.lax.map(covariance_rows, centre_blocks).reshape(-1, len(jacobian))[: len(scaled_centres)]


def check_cells(mesh: Mesh) -> None:
    """Raise `ValueError` if the mesh's cells are traced, because the prior must know which cells are neighbours."""
    advice_to_user = "close over the mesh, and put into it what varies: eqx.tree_at(lambda m: m.points, mesh, points)"
    check_has_values("mesh: its cells", mesh.cells, "the prior's neighbours are found from", advice_to_user)


def cell_factorisation(mesh: Mesh, groups) -> tuple[SparsityPattern, FactorisationPlan]:
    """Sparsity pattern and factorisation plan of matrices over cells whose entries couple the cells of each of
    `groups`. The coordinates of the mesh's points may be traced."""
    centres = centroids(mesh)
    with jax.ensure_compile_time_eval():
        pattern = SparsityPattern.from_elements(groups, size=mesh.num_cells)
        return pattern, analyse(pattern, coordinates=np.asarray(centres) if has_values(centres) else None)
