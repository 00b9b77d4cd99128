"""Uncertainty of an image: its posterior distribution by the Laplace approximation.

The posterior is approximated by the Gaussian of the problem linearised at the minimum ĉ of ½ rᵀGr + penalty(c), with
the residual r of the data and its precision G. The covariance of the coefficients c,

    Σ = (Q + JᵀGJ)⁻¹ = Q⁻¹ - Q⁻¹Jᵀ(JQ⁻¹Jᵀ + C)⁻¹JQ⁻¹

is computed in data space, with the Jacobian J at ĉ, the data covariance C = G⁻¹ and the prior precision Q. The
coefficients of smooth (Gaussian) priors are scaled so that Q = I; Σ is then exact if voltages are linear in c.
Tarantola, Inverse Problem Theory (SIAM 2005), ch. 3; Kaipio and Somersalo, Statistical and Computational Inverse
Problems (Springer 2005), ch. 3; MacKay, Neural Comput. 4 (1992) 415-447.

For total variation, Q is the quadratic form of lagged diffusivity, which touches the energy at ĉ from above (Vogel and
Oman, SIAM J. Sci. Comput. 17 (1996) 227-238). A jump of height d between cells has a stiffness proportional to 1 / √(d²
+ β²). Σ is therefore conditional on the estimated edges: Σ is the covariance if the positions of the edges, and roughly
their heights, were known. The true uncertainty is larger at an edge: there the energy has a smaller curvature than Q,
and an edge at a different position may explain the data as well.

To first order the voltages of a small body are those of its strength s (see `jeit.inverse.shapes.quantities`): with the
Jacobian J_e of a cell e of measure |e| and the background conductivity σ, they are n σ s J_e / |e| in n dimensions.
`detectable_strength` compares them with the noise.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.special
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jeit.arguments import check_has_values, check_key, check_kind, describe
from jeit.forward import ForwardModel
from jeit.forward.model import check_model, evaluate, fields_and_impedance_of, jacobian_blocks
from jeit.inverse.linearisation import used_channels
from jeit.inverse.nonlinear.problem import Inversion, check_background
from jeit.inverse.nonlinear.reconstruct import Reconstruction
from jeit.inverse.prior.bases import expand_rows
from jeit.inverse.prior.penalties import AbstractNormal
from jeit.mesh import measures
from jeit_solvers import Status
from jeit_solvers.engines import as_array, has_values, namespace, numpy_or_compiled, on_host
from jeit_solvers.module import Module

# Number of rows, each of the size of an image, that are computed at a time.
_ROWS_AT_ONCE = 32
# Norm of a body's voltages, each divided by its noise, from which the body is detected; and their root mean square from
# which a body that is alone is detected, because in a frame of more noise inclusions do not exceed the noise of the
# image. In simulated tanks, 114 of 115 bodies above the norm were detected, and one of 3 below it. Single bodies were
# detected in 12 of 12 frames at a root mean square of 1.1, in 8 of 12 at 0.85, and in none of 18 at 0.6.
_MIN_DETECTABLE_NORM, _MIN_DETECTABLE_RMS = 8.0, 1.0
# Maximum number of cells of which the detectable strength is computed for `detectable_diameters`.
_MAX_EXAMINED_CELLS = 4000
# Share of the area or volume in which a body of the larger `DetectableDiameters` is detected.
_ALMOST_ALL = 0.95


class Posterior(Module):
    """Posterior of an image: a Gaussian distribution of the image's coefficients with mean ĉ, created by `posterior`.

    **Fields**: `inversion`: the least squares problem; `coefficients` (n,): ĉ; `jacobian` (r, n): Jacobian J at ĉ;
    `root` (r, r): W with WᵀW = (JQ⁻¹Jᵀ + C)⁻¹; `cross` (r, n): JQ⁻¹; `prior`: normal distribution of precision Q.

    **Example:**

    ```python
    known = posterior(reconstruct(model, voltages, 1.0, prior=Gaussian(0.03), hyperparameter=1.0))
    known.standard_deviation(), known.credible_interval()
    ```
    """

    inversion: Inversion
    coefficients: Float[Array, " n"]
    jacobian: Float[Array, "r n"]
    root: Float[Array, "r r"]
    cross: Float[Array, "r n"]
    prior: AbstractNormal

    def standard_deviation(self) -> Float[Array, " m"]:
        """Standard deviation of the conductivity of every cell, S/m (2-D: S), with the link linearised."""
        estimate, deviation_of_estimate = _sample_estimates(self)
        return self.inversion.link.slope(estimate) * deviation_of_estimate

    def credible_interval(self, probability: float = 0.95) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Lower and upper limits, S/m (2-D: S), between which the conductivity of a cell lies with this `probability`,
        for each cell separately.

        The interval is computed on the link's scale, so its limits are positive and within bounds if the link requires
        this. Raises `ValueError` if the probability is not between 0 and 1.
        """
        if not 0 < probability < 1:
            raise ValueError(f"probability must lie between 0 and 1; it is {probability}.")
        normal_quantile = scipy.special.ndtri(0.5 + probability / 2)
        estimate, deviation_of_estimate = _sample_estimates(self)
        conductivity_link = self.inversion.link
        return conductivity_link.conductivity(
            estimate - normal_quantile * deviation_of_estimate
        ), conductivity_link.conductivity(estimate + normal_quantile * deviation_of_estimate)

    def region(self, cells: ArrayLike) -> tuple[float | Float[Array, ""], float | Float[Array, ""]]:
        """Mean conductivity of the selected `cells`, weighted by area (3-D: volume), and its standard deviation, S/m
        (2-D: S).

        `cells`: booleans (m,) or indices. Raises `ValueError` for an empty selection, invalid indices and traced cells.
        """
        cell_measures = on_host(measures(self.inversion.model.mesh))
        is_in_region = np.zeros(cell_measures.size, bool)
        is_in_region[_check_cells(cells, cell_measures.size)] = True
        region_weights = jnp.where(is_in_region, cell_measures, 0) / cell_measures[is_in_region].sum()
        mean, deviation_of_mean = _weighted_mean(self, region_weights)
        return (float(mean), float(deviation_of_mean)) if has_values(mean) else (mean, deviation_of_mean)

    def unknowns(self) -> dict[str, Float[Array, " k"]]:
        """Standard deviations of the unknowns estimated along with the conductivity, in the units of
        `Reconstruction.unknowns`; obtained by linearisation for quantities whose logarithm was estimated."""
        model, unknown_values = self.inversion.model, self.inversion.values(self.coefficients)
        first_index = self.inversion.basis.num_coefficients
        coefficient_deviations = jnp.sqrt(1 - jnp.sum((self.root @ self.cross) ** 2, axis=0))
        deviations_by_name = {}
        for unknown, unknown_value in zip(self.inversion.unknowns, unknown_values, strict=True):
            deviation_tangent = jnp.ones_like(unknown_value)
            _, quantity_slope = jax.jvp(
                lambda unknown_values, parameter=unknown: parameter.quantity(model, unknown_values),
                (unknown_value,),
                (deviation_tangent,),
            )
            deviations_by_name[type(unknown).__name__] = (
                quantity_slope * unknown.deviation * coefficient_deviations[first_index : first_index + unknown.size]
            )
            first_index += unknown.size
        return deviations_by_name

    def sample(self, key: PRNGKeyArray, number: int) -> Float[Array, "number m"]:
        """Draw conductivities (number, m) from the posterior, S/m (2-D: S). Raises `ValueError` if `key` is not a key
        of `jax.random`."""
        check_key(key)
        prior_key, noise_key = jax.random.split(key)
        prior_draws = jax.random.normal(prior_key, (number, self.prior.num_draws(len(self.coefficients))))
        return as_array(_draw_samples(self, prior_draws, jax.random.normal(noise_key, (number, len(self.root)))))


def _check_cells(cells: ArrayLike, num_cells: int) -> np.ndarray:
    """Selected cells of a mesh, as indices or booleans. Raises `ValueError` for an empty selection, invalid indices and
    traced cells."""
    check_has_values("cells", cells, "the region is made of", "choose them outside")
    selected = np.asarray(cells)
    if selected.shape == (0,):
        selected = selected.astype(int)
    if (
        selected.ndim != 1
        or (selected.dtype == bool and selected.shape != (num_cells,))
        or selected.dtype.kind not in "iub"
    ):
        raise ValueError(f"cells must be booleans ({num_cells},), or indices (k,) of cells; got {describe(cells)}.")
    if selected.dtype != bool and selected.size and (selected.min() < 0 or selected.max() >= num_cells):
        raise ValueError(f"cells must be indices from 0 to {num_cells - 1}.")
    if not (selected.any() if selected.dtype == bool else selected.size):
        raise ValueError("cells: none is chosen; give at least one.")
    return selected


def posterior(reconstruction: Reconstruction) -> Posterior:
    """Posterior distribution of a reconstruction, by the Laplace approximation.

    With a smooth prior, the standard deviations are as accurate as the noise, the prior and the forward model: with λ =
    1 and the correct prior variance, credible intervals have their nominal coverage; λ = 2 assumes that the image
    varies half as much as the prior says. With total variation, the standard deviations are conditional on the
    estimated edges: they are valid if the positions of the edges, and roughly their heights, are known, and are too
    small at an edge that may lie elsewhere. Raises `ValueError` for bounded solvers, whose posterior is not nearly
    Gaussian, for a failed reconstruction, and for any other object.

    **Arguments:**

    - `reconstruction`: result of `reconstruct`.

    **Example:**

    ```python
    known = posterior(reconstruct(model, voltages, 1.0, prior=Gaussian(0.03), hyperparameter=1.0))
    lower, upper = known.credible_interval(0.9)
    ```
    """
    check_kind("reconstruction", reconstruction, Reconstruction, "what reconstruct has returned")
    inversion, coefficients = reconstruction.inversion, reconstruction.coefficients
    if has_values(reconstruction.outcome) and Status.FAILED.number in np.ravel(reconstruction.outcome):
        raise ValueError(f"posterior: the reconstruction failed. {reconstruction.reason}")
    if not has_values(inversion, coefficients):
        return _compute_posterior(inversion, coefficients)
    # Compilation takes seconds, and for a solid body compiled programs would store several copies of the Jacobian.
    with np.errstate(all="ignore"):
        host_inversion, host_coefficients = on_host((inversion, coefficients))
        jacobian, cross_covariance, data_covariance, normal = _data_space_matrices(host_inversion, host_coefficients)
        inverse_root = scipy.linalg.inv(np.linalg.cholesky(data_covariance))
    return Posterior(host_inversion, host_coefficients, jacobian, inverse_root, cross_covariance, normal)


@eqx.filter_jit
def _compute_posterior(inversion: Inversion, coefficients) -> Posterior:
    jacobian, cross_covariance, data_covariance, normal = _data_space_matrices(inversion, coefficients)
    lower_factor = jnp.linalg.cholesky(data_covariance)
    inverse_root = jax.scipy.linalg.solve_triangular(lower_factor, jnp.eye(len(lower_factor)), lower=True)
    return Posterior(inversion, coefficients, jacobian, inverse_root, cross_covariance, normal)


def _data_space_matrices(inversion: Inversion, coefficients):
    """Matrices J, JQ⁻¹ and JQ⁻¹Jᵀ + C of the posterior, and the prior normal distribution of precision Q."""
    normal = inversion.penalty.normal(coefficients)
    if normal is None:
        raise ValueError(
            "posterior: only for unbounded solvers, for what bounds cut off is no Gaussian; take link=Bounded(lower, "
            "upper) in place of bounds."
        )
    _, jacobian = inversion.linearise(coefficients)
    cross_covariance = normal.covariance_product(jacobian.T).T
    return jacobian, cross_covariance, cross_covariance @ jacobian.T + inversion.data.covariance, normal


@numpy_or_compiled
def _sample_estimates(posterior: Posterior):
    """Posterior mean of the image x, including unknowns that change the image, and its standard deviation, per cell, on
    the link's scale.

    The columns of S are the shapes and the contributions of the unknowns to the image. The variance of x is diag(S Q⁻¹
    Sᵀ) - diag(S Q⁻¹Jᵀ WᵀW JQ⁻¹ Sᵀ); the rows W JQ⁻¹ Sᵀ are computed in blocks.
    """
    inversion, coefficients = posterior.inversion, posterior.coefficients
    basis, xp = inversion.basis, namespace(posterior)
    estimate, num_basis = inversion.estimate(coefficients), basis.num_coefficients
    # An unknown changes the image linearly or not at all.
    unknown_indicators = [
        np.arange(len(coefficients)) == coefficient_index for coefficient_index in range(num_basis, len(coefficients))
    ]
    unknown_images = [inversion.estimate(coefficients + unit_vector) - estimate for unit_vector in unknown_indicators]
    variance = posterior.prior.variance(basis) + sum(image**2 for image in unknown_images)
    num_rows = len(posterior.root)
    for first_row in range(0, num_rows, _ROWS_AT_ONCE):
        gain_rows = posterior.root[first_row : first_row + _ROWS_AT_ONCE] @ posterior.cross
        row_images = expand_rows(basis, gain_rows[:, :num_basis])
        for coefficient_index, image in enumerate(unknown_images):
            row_images = row_images + gain_rows[:, num_basis + coefficient_index, None] * image
        variance = variance - (row_images**2).sum(axis=0)
    return estimate, xp.sqrt(xp.maximum(variance, 0))


@numpy_or_compiled
def _weighted_mean(posterior: Posterior, weight):
    """Sum of the cells' conductivities weighted with `weight` (m,), and the posterior standard deviation of the sum."""
    inversion, coefficients, xp = posterior.inversion, posterior.coefficients, namespace(posterior, weight)
    estimate, num_basis = inversion.estimate(coefficients), inversion.basis.num_coefficients
    weighted_slope = weight * inversion.link.slope(estimate)
    unknown_indicators = [
        np.arange(len(coefficients)) == coefficient_index for coefficient_index in range(num_basis, len(coefficients))
    ]
    unknown_slopes = [
        weighted_slope @ (inversion.estimate(coefficients + unit_vector) - estimate)
        for unit_vector in unknown_indicators
    ]
    gradient = xp.concatenate(
        [inversion.basis.restrict(weighted_slope[None])[0], xp.asarray(unknown_slopes, weighted_slope.dtype)]
    )
    prior_variance = gradient @ posterior.prior.covariance_product(gradient[:, None])[:, 0]
    variance = prior_variance - xp.sum((posterior.root @ (posterior.cross @ gradient)) ** 2)
    return weight @ inversion.link.conductivity(estimate), xp.sqrt(xp.maximum(variance, 0))


@numpy_or_compiled
def _draw_samples(posterior: Posterior, prior_draws, noise_draws):
    """Sample conductivities from the posterior: c = ĉ + z - Q⁻¹Jᵀ(JQ⁻¹Jᵀ + C)⁻¹(Jz + e), where z is drawn from the
    prior and e from the noise."""
    inversion, inverse_root, xp = posterior.inversion, posterior.root, namespace(posterior, prior_draws)
    prior_samples = posterior.prior.draw_samples(prior_draws.T).T
    data_samples = prior_samples @ posterior.jacobian.T + noise_draws @ xp.linalg.cholesky(inversion.data.covariance).T
    coefficient_samples = prior_samples - (data_samples @ inverse_root.T @ inverse_root) @ posterior.cross
    return xp.stack(
        [
            inversion.conductivity(sampled_coefficients)
            for sampled_coefficients in posterior.coefficients + coefficient_samples
        ]
    )


def image_noise(reconstruction: Reconstruction) -> Float[np.ndarray, " m"]:
    """Standard deviation (m,) of an image in every cell due to the noise of the data alone, on the link's scale.

    The coefficients at the solution satisfy c = K (Jc - r), where K = Jᵀ(JJᵀ + C)⁻¹, r is the residual and J its
    Jacobian. Noise of covariance C therefore causes the covariance K C Kᵀ of the coefficients. If the image's misfit
    exceeds 1, the standard deviation is multiplied by the misfit. Raises `ValueError` for total variation and bounded
    solvers, for which this formula is not valid.

    **Arguments:**

    - `reconstruction`: result of `reconstruct`.

    **Example:**

    ```python
    image_noise(reconstruct(model, voltages, 1.0, prior=Gaussian(0.03), hyperparameter=1.0))
    ```
    """
    if not reconstruction.inversion.penalty.is_standard_normal:
        raise ValueError("reconstruction: only images with smooth priors and unbounded solvers have such a noise.")
    inversion, coefficients = on_host((reconstruction.inversion, reconstruction.coefficients))
    _, jacobian = inversion.linearise(coefficients)
    covariance, num_basis = inversion.data.covariance, inversion.basis.num_coefficients
    noise_root = np.linalg.cholesky(covariance).T @ np.linalg.inv(jacobian @ jacobian.T + covariance)
    variance = np.zeros(len(inversion.reference))
    for first_row in range(0, len(noise_root), _ROWS_AT_ONCE):
        gain_rows = noise_root[first_row : first_row + _ROWS_AT_ONCE] @ jacobian
        variance += np.sum([inversion.basis.expand(row[:num_basis]) ** 2 for row in gain_rows], axis=0)
    return max(1.0, float(reconstruction.misfit)) * np.sqrt(variance)


class DetectableDiameters(NamedTuple):
    """Diameters, metres, of the smallest round insulating bodies that are detected; infinite if even a body as large as
    the domain is not.

    **Fields**: `median`: in half of the area (3-D: volume) of a domain; `almost_everywhere`: in 95 % of it.

    **Example:**

    ```python
    median, almost_everywhere = detectable_diameters(model, 1.0, noise=1e-6)
    ```
    """

    median: float
    almost_everywhere: float


def detectable_strength(
    model: ForwardModel,
    background: ArrayLike,
    noise: Float[Array, " M"] | float,
    mask: Bool[Array, " M"] | None = None,
    cells: ArrayLike | None = None,
) -> Float[np.ndarray, " k"]:
    """Smallest strength (k,), in m² (3-D: m³), with which a small body in each cell is detected.

    The strength of a body of area A (3-D: volume) with ρ times the conductivity of the background is A |ρ - 1| / (ρ +
    1) in a sheet, and A |ρ - 1| / (ρ + 2) in a solid. A body is detected by the default imaging method if its voltages,
    each divided by the standard deviation of its noise, have a norm of at least 8 and a root mean square of at least 1.
    Beside other bodies the norm alone decides, but two of one sign may be taken for one.

    **Arguments:**

    - `model`: the forward model.
    - `background`: conductivity without bodies, one number or (m,), S/m (2-D: S).
    - `noise`: standard deviation of a voltage difference, one number or (M,), volts.
    - `mask` (M,): True for usable channels.
    - `cells`: indices (k,) of the cells, or booleans (m,); default: all.

    Raises `ValueError` for invalid or traced arguments.

    **Example:**

    ```python
    strength = detectable_strength(model, 1.0, noise=1e-6)
    ```
    """
    check_model(model)
    arguments = "model, background or noise"
    check_has_values(arguments, (model, background, noise), "a detectable strength is computed from", "call it outside")
    conductivity = np.asarray(check_background(model, background))
    channel_indices, inverse_noise = used_channels(model, noise, mask)
    fields = evaluate(model, fields_and_impedance_of, conductivity)[0]
    mesh, protocol, fields = on_host((model.mesh, model.protocol.subset(channel_indices), fields))
    if cells is not None:
        cells = _check_cells(cells, mesh.num_cells)
        mesh, conductivity = eqx.tree_at(lambda mesh: mesh.cells, mesh, mesh.cells[cells]), conductivity[cells]
    squared_norm = np.empty(mesh.num_cells)
    for cell_block, jacobian in jacobian_blocks(mesh, protocol, fields):
        squared_norm[cell_block] = np.square(inverse_noise) @ np.square(jacobian)
    min_norm = max(_MIN_DETECTABLE_NORM, _MIN_DETECTABLE_RMS * np.sqrt(len(channel_indices)))
    with np.errstate(divide="ignore"):  # infinite where no channel in use is sensitive
        return min_norm * np.asarray(measures(mesh)) / (mesh.dimension * conductivity * np.sqrt(squared_norm))


def detectable_diameters(
    model: ForwardModel,
    background: ArrayLike,
    noise: Float[Array, " M"] | float,
    mask: Bool[Array, " M"] | None = None,
) -> DetectableDiameters:
    """Diameters of the smallest round insulating bodies that are detected, see `detectable_strength`. Of a large mesh,
    a random selection of cells is examined.

    **Arguments:**

    - `model`, `background`, `noise`, `mask`: as in `detectable_strength`.

    Raises `ValueError` for invalid or traced arguments.

    **Example:**

    ```python
    diameters = detectable_diameters(model, 1.0, noise=1e-6)
    ```
    """
    check_model(model)
    num_cells, cells = model.mesh.num_cells, None
    if num_cells > _MAX_EXAMINED_CELLS:
        cells = np.sort(np.random.default_rng(0).choice(num_cells, _MAX_EXAMINED_CELLS, replace=False))
    strengths_of_cells = detectable_strength(model, background, noise, mask, cells)
    cell_measures = np.asarray(measures(on_host(model.mesh)))
    body_measure, cell_weights = float(cell_measures.sum()), cell_measures if cells is None else cell_measures[cells]
    return _diameters(strengths_of_cells, cell_weights, body_measure, model.mesh.dimension)


def _diameters(detectable_strengths, cell_weights, max_measure: float, dimension: int) -> DetectableDiameters:
    """Diameters of insulating bodies of the `detectable_strengths` in cells with `cell_weights`; infinite for areas or
    volumes above `max_measure`."""
    order_by_strength = np.argsort(detectable_strengths)
    cumulative_shares = np.cumsum(cell_weights[order_by_strength]) / cell_weights.sum()
    # An insulating disk has its area as strength, an insulating ball half its volume.
    quantile_measures = detectable_strengths[
        order_by_strength[np.searchsorted(cumulative_shares, (0.5, _ALMOST_ALL))]
    ] * (1 if dimension == 2 else 2)
    diameters = 2 * np.sqrt(quantile_measures / np.pi) if dimension == 2 else np.cbrt(6 * quantile_measures / np.pi)
    return DetectableDiameters(*np.where(quantile_measures < max_measure, diameters, np.inf).tolist())
