"""The Matérn prior, and the table of priors by name.

In unbounded space, the solution of (κ² - Δ) x = white noise has the Matérn correlation of smoothness ν = 2 - d / 2,

    d = 2:  κr K₁(κr),    d = 3:  exp(-κr).

The covariance of the nodal values is A⁻¹ M A⁻¹ with A = κ²M + K, mass matrix M and stiffness matrix K. Products with
this covariance require sparse solves; the covariance itself would be a dense matrix over all pairs of cells. Lindgren,
Rue and Lindström, J. R. Stat. Soc. B 73 (2011) 423-498. The domain's wall reflects the field and raises the field's
variance near the wall. The Robin condition ∂x/∂n = -κx / 1.42 removes most of this excess (Roininen, Huttunen and
Lasanen, Inverse Probl. Imaging 8 (2014) 561-586), and the nodal values are scaled to unit variance to remove the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from jeit.arguments import check_has_values
from jeit.inverse.prior.bases import DenseBasis
from jeit.inverse.prior.linear_algebra import NodalSystem, Solve, apply_to_columns
from jeit.inverse.prior.priors import AbstractPrior, Gaussian, Laplace, Noser, Tikhonov, informed_shapes
from jeit.mesh import Mesh, gradients, measures
from jeit.mesh.mesh import facet_measures
from jeit_solvers.engines import has_values, host, on_host

# Length in the Robin condition at the wall, in units of 1/κ.
_ROBIN_COEFFICIENT = 1.42
# Number of nodes up to which variances are computed exactly.
_MAX_EXACT_NODES = 3000
# Number of random fields from which variances are estimated on larger meshes.
_NUM_SAMPLED_FIELDS = 400
# Number of random fields processed at a time.
_COLUMNS_AT_ONCE = 50


class Matern(AbstractPrior):
    """Matérn prior: a smooth random field of unit variance.

    The correlation falls to 0.14 at twice the correlation length, as for `Gaussian(length)`, but is more sharply peaked
    at distance zero, so images have sharper peaks. κ is 1 / length in a solid body, √2 / length in a sheet. The cells
    must not be much larger than the length. Memory and time are roughly proportional to the number of nodes.

    **Arguments:**

    - `length`: correlation length in metres.

    Raises `ValueError` if the length is not positive.

    **Example:**

    ```python
    image = one_step(model, 1.0, prior=Matern(0.02), hyperparameter=0.01, noise=1e-4).image(change)
    ```
    """

    length: float

    def __check_init__(self):
        if has_values(self.length) and not (np.isfinite(self.length) and self.length > 0):
            raise ValueError(f"length must be positive, in metres; it is {self.length}.")

    def covariance_product(self, mesh, jacobian):
        """Product Γ Jᵀ, computed by two sparse solves."""
        matern_field = self._field(mesh, jacobian)
        jacobian_columns: Any = np.asarray(on_host(jacobian)).T
        if np.iscomplexobj(jacobian_columns):
            return host.asarray(
                matern_field.product(jacobian_columns.real) + 1j * matern_field.product(jacobian_columns.imag)
            )
        return host.asarray(matern_field.product(jacobian_columns))

    def precision(self, mesh, jacobian):
        """Not available for this prior. Raises `ValueError`."""
        raise ValueError(
            "prior: Matern is a field of the nodes and has no precision matrix of cells, which bounds need; take "
            "Noser, Tikhonov, Laplace or TotalVariation, or link=Bounded(lower, upper) in place of bounds."
        )

    def basis(self, mesh, jacobian):
        """Basis with one shape for each node: the response of the cells to white noise at this node."""
        return DenseBasis(host.asarray(self._field(mesh, jacobian).shapes()))

    def informed_basis(self, mesh, jacobian):
        """Basis of the shapes of this prior that the data resolve (`informed_shapes`)."""
        matern_field = self._field(mesh, jacobian)
        return informed_shapes(np.asarray(jacobian), matern_field.product, matern_field.variance())

    def _field(self, mesh: Mesh, jacobian) -> "_MaternField":
        advice_to_user = "take Gaussian(length), which can be differentiated"
        check_has_values(
            "model, or the prior's length", (mesh, jacobian, self.length), "a Matérn field is made", advice_to_user
        )
        return _MaternField.create(mesh, float(self.length))


class _MaternField(NamedTuple):
    """Matérn field on the nodes of a mesh.

    **Fields**: `means` (m, n): matrix that averages nodal values over each cell; `solve`: function that solves systems
    with A = κ²M + K; `mass` (n,): lumped mass M of the nodes; `scale` (n,): factors that give every node unit variance;
    `fields` (n, k): F, where F Fᵀ approximates the covariance of the nodal values.
    """

    means: scipy.sparse.csr_array
    solve: Solve
    mass: Float[np.ndarray, " n"]
    scale: Float[np.ndarray, " n"]
    fields: Float[np.ndarray, "n k"]

    @classmethod
    def create(cls, mesh: Mesh, length: float) -> "_MaternField":
        system = NodalSystem.create(mesh)
        mesh = system.mesh
        nodes_per_cell, num_nodes = mesh.cells.shape[1], mesh.num_points
        inverse_length = (1.0 if mesh.dimension == 3 else np.sqrt(2)) / length
        basis_gradients, cell_measures = np.asarray(gradients(mesh)), np.asarray(measures(mesh))
        stiffness = np.einsum("mid,mjd,m->mij", basis_gradients, basis_gradients, cell_measures)
        mass = np.bincount(mesh.cells.ravel(), np.repeat(cell_measures / nodes_per_cell, nodes_per_cell), num_nodes)
        wall_measures = np.asarray(facet_measures(mesh)) / mesh.dimension
        wall_node_measures = np.bincount(mesh.facets.ravel(), np.repeat(wall_measures, mesh.dimension), num_nodes)
        solve_system = system.inverse(
            system.assemble(
                stiffness, inverse_length**2 * mass + inverse_length / _ROBIN_COEFFICIENT * wall_node_measures
            )
        )
        fields = _covariance_factor(solve_system, mass)
        inverse_field_deviation = 1 / np.sqrt(np.einsum("nk,nk->n", fields, fields))
        return cls(system.means, solve_system, mass, inverse_field_deviation, inverse_field_deviation[:, None] * fields)

    def variance(self) -> Float[np.ndarray, " m"]:
        """Variance of the field in every cell."""
        field_blocks = np.array_split(self.fields, max(1, self.fields.shape[1] // _COLUMNS_AT_ONCE), axis=1)
        return np.sum([((self.means @ fields) ** 2).sum(axis=1) for fields in field_blocks], axis=0)

    def product(self, columns: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "m k"]:
        """Covariance Γ of the cells times `columns`."""

        def multiply_block(column_slice: Any) -> Any:
            nodal_columns = self.scale[:, None] * (self.means.T @ column_slice)
            return self.means @ (self.scale[:, None] * self.solve(self.mass[:, None] * self.solve(nodal_columns)))

        return apply_to_columns(multiply_block, columns, len(columns))

    def shapes(self) -> Float[np.ndarray, "m n"]:
        """Shapes S with Γ = S Sᵀ, the covariance of the cells."""
        return self.means @ (self.scale[:, None] * self.solve(np.diag(np.sqrt(self.mass))))


def _covariance_factor(solve: Solve, mass: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
    """Factor F of the covariance of the nodal values, F Fᵀ = A⁻¹ M A⁻¹. For a large mesh the columns of F are random
    fields with this covariance, so that F Fᵀ approximates its diagonal."""
    if len(mass) <= _MAX_EXACT_NODES:
        return solve(np.diag(np.sqrt(mass)))
    noise = np.random.default_rng(0).standard_normal((len(mass), _NUM_SAMPLED_FIELDS)) / np.sqrt(_NUM_SAMPLED_FIELDS)
    return solve(np.sqrt(mass)[:, None] * noise)


DEFAULT_PRIOR = Noser()
"""Default prior of `one_step` and `reconstruct`: it needs no correlation length, so it can be used for bodies of which
nothing is known."""
MEASURED_DATA_PRIOR = "gaussian"
"""Name in `PRIORS` of the default prior for measured data and streams."""


def smooth_prior(size: float) -> Gaussian:
    """Smooth prior that worked on measured tanks and skins; `size`: longest side of the body, metres."""
    return Gaussian(0.085 * size)


def _matern(size: float) -> AbstractPrior:

    return Matern(smooth_prior(size).length)


PRIORS: dict[str, Callable[[float], AbstractPrior]] = {
    "tikhonov": lambda size: Tikhonov(),
    "laplace": lambda size: Laplace(),
    "noser": lambda size: Noser(),
    "gaussian": smooth_prior,
    "matern": _matern,
}
"""Quadratic priors by name: functions of the size of the body, its longest side in metres."""
