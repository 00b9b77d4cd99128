"""Measurement selection: choice of the most informative measurements among many candidates."""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments import check_key
from jeit_solvers.dense import inverse_cholesky
from jeit_solvers.engines import has_values
from jeit_solvers.module import Module


class Candidates(Module):
    """Sensitivities of M candidate measurements, whitened by the noise and by the prior.

    **Fields**: `rows` (M, r): the whitened sensitivity f_i of each candidate; `weight` (r, r): the matrix V such that
    tr VC is the weighted sum of the cells' variances for a posterior covariance C of the r whitened coefficients.

    **Example:**

    ```python
    candidates = Candidates.from_factor(changes.T, objective.prior.factor, noise=1e-4)
    selection = select_measurements(candidates, 6)
    ```
    """

    rows: Float[Array, "M r"]
    weight: Float[Array, "r r"]

    @classmethod
    def create(
        cls, jacobian: ArrayLike, product: ArrayLike, noise: ArrayLike, *, weights: ArrayLike | None = None
    ) -> "Candidates":
        """Create the candidates from the Jacobian and a prior with covariance Γ of the conductivities.

        - `jacobian`: Jacobian J (M, m) of M candidates with respect to m cells, as returned by `ForwardModel.jacobian`.
        - `product`: ΓJᵀ (m, M): result of the `covariance_product` of a prior, multiplied by the variance of the
          conductivity.
        - `noise`: standard deviation of the noise of each measurement (M,), or one value for all, volts.
        - `weights`: weights (m,) of the cells in criterion "A", all 1 by default; with the areas of the cells as
          weights, the criterion is an integral over the body.

        The result is exact for any prior. The computation takes O(M³) operations, and so suits up to a few thousand
        candidates. The function works under `jit` and `vmap`. Raises `ValueError` for incompatible shapes, values that
        are not finite, noise that is not positive, and negative weights.
        """
        jacobian, product, noise, weights = _check_candidates(
            jacobian, product, noise, weights, ("cells", "measurements")
        )
        if product.shape != jacobian.shape[::-1]:
            raise ValueError(f"product has shape {product.shape}; ΓJᵀ has one column for each of {len(jacobian)} rows.")
        return _candidates_from_product(jacobian, product, noise, weights)

    @classmethod
    def from_factor(
        cls, jacobian: ArrayLike, factor: ArrayLike, noise: ArrayLike, *, weights: ArrayLike | None = None
    ) -> "Candidates":
        """Create the candidates from the Jacobian and a prior with covariance SSᵀ, where `factor` is S (m, r). Other
        arguments as in `create`.

        This function suits any number of candidates, such as all drives with all measurements. If S omits small parts
        of the variance (as the `basis` of a prior does), the information of precise measurements on these parts is
        omitted too, and the `share` of a few measurements is overestimated. Raises `ValueError` as `create` does.
        """
        jacobian, factor, noise, weights = _check_candidates(
            jacobian, factor, noise, weights, ("cells", "coefficients")
        )
        return cls(jacobian @ factor / noise[:, None], factor.T @ (weights[:, None] * factor))

    @property
    def num_candidates(self) -> int:
        """Number of candidates, M."""
        return self.rows.shape[0]


def _check_candidates(
    jacobian, prior, noise, weights, prior_axis_names: tuple[str, str]
) -> tuple[Array, Array, Array, Array]:
    """Check the arguments of `Candidates` and convert them to arrays of matching shapes. `prior_axis_names`: names of
    the axes of `prior`, for error messages."""
    jacobian, prior = jnp.asarray(jacobian, float), jnp.asarray(prior, float)
    noise = jnp.asarray(noise, float)
    if jacobian.ndim != 2 or prior.ndim != 2 or jacobian.shape[1] != prior.shape[0]:
        raise ValueError(
            f"jacobian has shape {jacobian.shape} and the prior's matrix {prior.shape}; give (measurements, cells) and "
            f"({', '.join(prior_axis_names)})."
        )
    weights = jnp.ones(len(prior)) if weights is None else jnp.asarray(weights, float)
    if noise.shape not in ((), jacobian.shape[:1]):
        raise ValueError(f"noise has shape {noise.shape}; give one number, or one for each of {len(jacobian)} rows.")
    if weights.shape != prior.shape[:1]:
        raise ValueError(f"weights has shape {weights.shape}; give one for each of the {len(prior)} cells.")
    arrays_by_name = {"jacobian": jacobian, "the prior's matrix": prior, "noise": noise, "weights": weights}
    for name, values in arrays_by_name.items():
        if not has_values(values):
            continue
        if not np.isfinite(values).all():
            raise ValueError(f"{name} has NaN or infinite values; leave out measurements that have none.")
        if name == "noise" and np.min(values) <= 0:
            raise ValueError("noise must be positive: the standard deviation of each measurement, in volts.")
        if name == "weights" and np.min(values) < 0:
            raise ValueError("weights must not be negative.")
    return jacobian, prior, jnp.broadcast_to(noise, jacobian.shape[:1]), weights


@jax.jit
def _candidates_from_product(jacobian, prior_product, noise, weights) -> Candidates:
    """Compute the candidates from ΓJᵀ, with the factor S = ΓJᵀ N^-½ U Λ^-½ of the prior, where N^-½ JΓJᵀ N^-½ = UΛUᵀ
    and N is the covariance of the noise.

    SSᵀ is the part of the prior covariance Γ that the measurements depend on; the remaining part does not affect them.
    """
    whitened_product = jacobian @ prior_product / (noise[:, None] * noise)
    eigenvalues, eigenvectors = jnp.linalg.eigh((whitened_product + whitened_product.T) / 2)
    is_significant = eigenvalues > len(eigenvalues) * jnp.finfo(eigenvalues.dtype).eps * eigenvalues[-1]
    root_eigenvalues = jnp.sqrt(jnp.where(is_significant, eigenvalues, 1))
    prior_factor = prior_product @ (eigenvectors / noise[:, None] * jnp.where(is_significant, 1 / root_eigenvalues, 0))
    return Candidates(
        eigenvectors * jnp.where(is_significant, root_eigenvalues, 0),
        prior_factor.T @ (weights[:, None] * prior_factor),
    )


Criterion = Literal["D", "A"]
# Minimum relative gain of information by a swap, since rounding errors of smaller gains could cause endless swaps.
_MIN_INFORMATION_GAIN = 1e-9


class Selection(Module):
    """The chosen measurements, with their information and the information of all candidates.

    **Fields**

    - `chosen`: (N,) indices of the candidates, in the order of the greedy choice; `protocol.subset(chosen)` is the
      protocol that measures them.
    - `gains`: (N,) information added by each greedy choice, before any exchange; non-increasing for criterion "D".
    - `information`: information of the chosen measurements ("D": in nats, "A": decrease of the variance); `total`:
      information of all candidates.
    - `swaps`: number of swaps by the exchange; `settled`: whether no further swap increases the information.
    """

    chosen: Int[Array, " N"]
    gains: Float[Array, " N"]
    information: Float[Array, ""]
    total: Float[Array, ""]
    swaps: Int[Array, ""]
    settled: Bool[Array, ""]

    @property
    def share(self) -> Float[Array, ""]:
        """Information of the chosen measurements divided by the information of all candidates."""
        return self.information / self.total


def select_measurements(
    candidates: Candidates,
    number: int,
    *,
    criterion: Criterion = "D",
    exchange: bool = True,
    max_swaps: int | None = None,
) -> Selection:
    """Select `number` of the candidate measurements so that their information is as large as possible.

    The selection is greedy: each step adds the candidate with the largest gain of information. The result is
    deterministic. Criterion "D" is submodular, so the greedy set has at least 1 - 1/e of the maximum information;
    `information_bound` gives an upper bound for any set. A greedy choice takes O(M r) operations, a swap O(N M r), for
    M candidates of r coefficients. The function works under `jit` and `vmap`, for many layouts in one call.

    **Arguments:**

    - `candidates`: the M candidate measurements.
    - `number`: number N of measurements to select.
    - `criterion`: "D", the information in nats, or "A", the decrease of the weighted posterior variance.
    - `exchange`: whether chosen candidates are then swapped for others, the best swap first, until no swap increases
      the information (Fedorov's exchange).
    - `max_swaps`: maximum number of swaps, by default `number`.

    Raises `ValueError` if `number` is not from 1 to M, and for an unknown criterion.

    **Example:**

    ```python
    selection = select_measurements(candidates, 6)
    protocol = sheet.model.protocol.subset(selection.chosen)
    ```
    """
    _check_number(candidates, number, criterion)
    max_num_swaps = 0 if not exchange else number if max_swaps is None else max_swaps
    if not isinstance(max_num_swaps, int) or max_num_swaps < 0:
        raise ValueError(f"max_swaps must be a whole number from 0; it is {max_swaps!r}.")
    return _select_with_swaps(candidates, number, criterion, max_num_swaps)


def information(candidates: Candidates, chosen, *, criterion: Criterion = "D") -> Float[Array, "..."]:
    """Compute the information (...,) of sets of candidate measurements. `chosen` (..., N): N different indices per set.

    Raises `ValueError` for invalid indices, and for an unknown criterion.
    """
    chosen = jnp.asarray(chosen)
    if chosen.ndim == 0 or not jnp.issubdtype(chosen.dtype, jnp.integer):
        raise ValueError(f"chosen has shape {chosen.shape} of {chosen.dtype}; give integers (..., N).")
    _check_number(candidates, chosen.shape[-1], criterion)
    if has_values(chosen) and not ((chosen >= 0) & (chosen < candidates.num_candidates)).all():
        raise ValueError(f"chosen must be from 0 to {candidates.num_candidates - 1}.")
    return _information_of_sets(candidates, chosen.reshape(-1, chosen.shape[-1]), criterion).reshape(chosen.shape[:-1])


def information_bound(
    candidates: Candidates, number: int, *, criterion: Criterion = "D", iterations: int = 50
) -> Float[Array, ""]:
    """Compute an upper bound of the information of any set of `number` candidates.

    If fractions w_i of the candidates may be measured, 0 ≤ w_i ≤ 1 with Σw_i = N, the information is a concave function
    of w, and each tangent of this function is an upper bound. The Frank-Wolfe method maximises the information, and the
    lowest bound of its iterations is returned. The bound is tight if many candidates carry similar information, and
    loose if the noise is so low that every candidate adds information: fractions of all candidates then carry more
    information than any small set.

    Boyd and Vandenberghe, Convex Optimization (2004), section 7.5.

    **Arguments:**

    - `candidates`: the candidate measurements.
    - `number`: number N of measurements in a set.
    - `criterion`: "D" or "A", as in `select_measurements`.
    - `iterations`: number of Frank-Wolfe iterations; more iterations give a tighter bound.

    Raises `ValueError` if `number` is not from 1 to the number of candidates, and for an unknown criterion.

    **Example:**

    ```python
    bound = information_bound(candidates, 6)
    print(select_measurements(candidates, 6).share, bound)
    ```
    """
    _check_number(candidates, number, criterion)
    return _relaxed_bound(candidates, number, criterion, iterations)


def random_selections(key: Array, num_candidates: int, number: int, count: int) -> Int[Array, "count N"]:
    """Draw `count` sets of `number` different candidates each, all sets equally likely, as indices (count, number).

    Raises `ValueError` if `number` is not from 1 to `num_candidates`.
    """
    if not 1 <= number <= num_candidates:
        raise ValueError(f"number must be from 1 to the {num_candidates} candidates; it is {number}.")
    check_key(key)
    random_orders = jax.vmap(lambda permutation_key: jax.random.permutation(permutation_key, num_candidates))(
        jax.random.split(key, count)
    )
    return random_orders[:, :number]


def nearest_pairs(centres, number: int, *, lengths=None) -> Int[np.ndarray, " N"]:
    """Find the `number` pairs of electrodes with the shortest distance, as indices of channels of `two_terminal(L)`,
    the protocol that measures all pairs of L electrodes.

    `centres`: positions (L, d) of the electrodes, metres. `lengths`: distances (L, L) between the electrodes, metres,
    such as distances along a surface from `SurfaceLayout.lengths`; by default the straight distances. With the nearest
    pairs, every position of the skin is measured by electrodes close to it. Pairs of equal distance are taken in the
    order of the channels. Raises `ValueError` if `number` is not from 1 to L(L - 1)/2.
    """
    return _pairs_by_length(centres, number, 1, lengths)


def farthest_pairs(centres, number: int, *, lengths=None) -> Int[np.ndarray, " N"]:
    """Find the `number` pairs of electrodes with the longest distance, which drive current through the whole skin.

    Arguments as in `nearest_pairs`. Raises `ValueError` if `number` is not from 1 to L(L - 1)/2.
    """
    return _pairs_by_length(centres, number, -1, lengths)


def _pairs_by_length(centres, number: int, length_sign: int, lengths) -> np.ndarray:
    centres = np.asarray(centres, float)
    first_electrodes, second_electrodes = np.triu_indices(len(centres), 1)
    if not 1 <= number <= len(first_electrodes):
        raise ValueError(
            f"number must be from 1 to the {len(first_electrodes)} pairs of {len(centres)} electrodes; it is {number}."
        )
    # Distances are rounded to a nanometre, so that pairs of equal distance are taken in the order of the channels.
    if lengths is None:
        lengths = np.linalg.norm(centres[:, None] - centres, axis=-1)
    elif np.shape(lengths) != (len(centres), len(centres)):
        raise ValueError(
            f"lengths has shape {np.shape(lengths)}; give one between any two of {len(centres)} electrodes."
        )
    pair_lengths = np.asarray(lengths, float)[first_electrodes, second_electrodes].round(9)
    return np.argsort(length_sign * pair_lengths, kind="stable")[:number]


def _check_number(candidates: Candidates, number: int, criterion: Criterion) -> None:
    if criterion not in ("D", "A"):
        raise ValueError(f"criterion must be 'D' or 'A'; it is {criterion!r}.")
    if not isinstance(number, int) or not 1 <= number <= candidates.num_candidates:
        raise ValueError(f"number must be a whole number from 1 to {candidates.num_candidates}; it is {number!r}.")


@partial(jax.jit, static_argnames=("number", "criterion"))
def _select_with_swaps(candidates: Candidates, number: int, criterion: Criterion, max_num_swaps) -> Selection:
    chosen, gains = _greedy_selection(candidates, number, criterion)
    total, _ = _information_and_slope(candidates, jnp.ones(candidates.num_candidates), criterion)

    def can_improve(search_state):
        _, num_swaps, has_converged = search_state
        return (num_swaps < max_num_swaps) & ~has_converged

    def make_best_swap(search_state):
        chosen, num_swaps, _ = search_state
        swap_gains = _swap_gains(candidates, chosen, criterion)
        removed_position, added_candidate = jnp.unravel_index(jnp.argmax(swap_gains), swap_gains.shape)
        improves_information = swap_gains[removed_position, added_candidate] > _MIN_INFORMATION_GAIN * total
        return (
            jnp.where(improves_information, chosen.at[removed_position].set(added_candidate), chosen),
            num_swaps + improves_information,
            ~improves_information,
        )

    chosen, num_swaps, has_converged = jax.lax.while_loop(
        can_improve, make_best_swap, (chosen, jnp.array(0), jnp.array(False))
    )
    final_information = _information_of_sets(candidates, chosen[None], criterion)[0]
    return Selection(chosen, gains, final_information, total, num_swaps, has_converged)


def _greedy_selection(candidates: Candidates, number: int, criterion: Criterion):
    """Indices (N,) of the greedily chosen candidates, and the gain of information of each. The choice is a pivoted
    Cholesky factorisation of I + FFᵀ, where F has the rows f_i, with the best candidate as the next pivot.

    Choosing candidate p changes the posterior covariance from C to C - uuᵀ with u = C f_p / √(1 + f_pᵀC f_p). The rows
    of `chosen_directions` are the vectors u of the previous steps.
    """
    rows, weight = candidates.rows, candidates.weight

    def times_covariance(chosen_directions, vector):
        return vector - chosen_directions.T @ (chosen_directions @ vector)

    def choose_next(search_state, choice_index):
        chosen_directions, row_variances, trace_reductions, is_unchosen = search_state
        gains = jnp.log1p(row_variances) if criterion == "D" else trace_reductions / (1 + row_variances)
        best_candidate = jnp.argmax(jnp.where(is_unchosen, gains, -jnp.inf))
        new_direction = times_covariance(chosen_directions, rows[best_candidate]) / jnp.sqrt(
            1 + row_variances[best_candidate]
        )
        row_projections = rows @ new_direction
        if criterion == "A":
            # Update f_jᵀCVC f_j to the new covariance C, which changes C f_j by a multiple of `row_projections`.
            weighted_direction = weight @ new_direction
            weighted_projections = rows @ times_covariance(chosen_directions, weighted_direction)
            trace_reductions = jnp.maximum(
                trace_reductions
                - 2 * row_projections * weighted_projections
                + (new_direction @ weighted_direction) * row_projections**2,
                0,
            )
        search_state = (
            chosen_directions.at[choice_index].set(new_direction),
            jnp.maximum(row_variances - row_projections**2, 0),
            trace_reductions,
            is_unchosen.at[best_candidate].set(False),
        )
        return search_state, (best_candidate, gains[best_candidate])

    row_variances = jnp.sum(rows**2, axis=1)  # f_jᵀC f_j: remaining variance of measurement j
    trace_reductions = jnp.sum((rows @ weight) * rows, axis=1)  # f_jᵀCVC f_j
    chosen_directions = jnp.zeros((number, rows.shape[1]))
    initial_state = (chosen_directions, row_variances, trace_reductions, jnp.ones(len(rows), bool))
    return jax.lax.scan(choose_next, initial_state, jnp.arange(number))[1]


def _swap_gains(candidates: Candidates, chosen, criterion: Criterion) -> Float[Array, "N M"]:
    """Gain (N, M) of information by swapping the i-th chosen candidate for candidate j; -inf where j is already chosen.

    With c_ij = f_iᵀC f_j and b_ij = f_iᵀCVC f_j, where C is the posterior covariance for the chosen set, a swap
    multiplies det C⁻¹ by q = (1 + c_jj)(1 - c_ii) + c_ij² and lowers tr VC by
    ((1 - c_ii) b_jj + 2 c_ij b_ij - (1 + c_jj) b_ii) / q.
    """
    rows, weight = candidates.rows, candidates.weight
    chosen_rows = rows[chosen]
    row_products = chosen_rows @ rows.T
    # F_T are the rows of the chosen set. C F_Tᵀ = F_Tᵀ (I + F_T F_Tᵀ)⁻¹ gives c_ij and 1 - c_ii without differences of
    # large numbers.
    inverse_factor = _inverse_factor(row_products[:, chosen])
    whitened_products = inverse_factor @ row_products
    c_j = jnp.maximum(jnp.sum(rows**2, axis=1) - jnp.sum(whitened_products**2, axis=0), 0)
    c_ij = inverse_factor.T @ whitened_products
    one_minus_c_ii = jnp.sum(inverse_factor**2, axis=0)[:, None]  # 1 - c_ii
    determinant_ratio = (1 + c_j) * one_minus_c_ii + c_ij**2
    if criterion == "D":
        gains = jnp.log(determinant_ratio)
    else:
        residual_rows = rows - c_ij.T @ chosen_rows  # rows f_jᵀC
        weighted_chosen_rows = inverse_factor.T @ (inverse_factor @ chosen_rows) @ weight  # rows f_iᵀCV
        b_ij = weighted_chosen_rows @ residual_rows.T
        b_j = jnp.sum((residual_rows @ weight) * residual_rows, axis=1)
        gains = (one_minus_c_ii * b_j + 2 * c_ij * b_ij - (1 + c_j) * b_j[chosen][:, None]) / determinant_ratio
    return gains.at[:, chosen].set(-jnp.inf)


def _information_of_set(candidates: Candidates, weighted_rows: Float[Array, "M r"], chosen, criterion: Criterion):
    """Information of one set of N candidates, from the N × N matrix I + F_T F_Tᵀ, where F_T are the rows of the set.
    `weighted_rows`: the rows of all candidates times V."""
    chosen_rows = candidates.rows[chosen]
    inverse_factor = _inverse_factor(chosen_rows @ chosen_rows.T)
    if criterion == "D":
        return -2 * jnp.sum(jnp.log(jnp.diag(inverse_factor)))
    return jnp.sum((inverse_factor @ weighted_rows[chosen]) * (inverse_factor @ chosen_rows))


@partial(jax.jit, static_argnames="criterion")
def _information_of_sets(candidates: Candidates, candidate_sets, criterion: Criterion):
    weighted_rows = candidates.rows @ candidates.weight
    return jax.lax.map(
        lambda chosen: _information_of_set(candidates, weighted_rows, chosen, criterion), candidate_sets, batch_size=64
    )


def _information_and_slope(candidates: Candidates, measured_fractions: Float[Array, " M"], criterion: Criterion):
    """Information if candidate i is measured with the weight `measured_fractions[i]`, and the derivative (M,) of the
    information with respect to the weights, from the inverse posterior covariance C⁻¹ (r, r)."""
    rows, weight = candidates.rows, candidates.weight
    inverse_factor = _inverse_factor(rows.T @ (measured_fractions[:, None] * rows))
    whitened_products = inverse_factor @ rows.T
    if criterion == "D":
        return -2 * jnp.sum(jnp.log(jnp.diag(inverse_factor))), jnp.sum(whitened_products**2, axis=0)  # f_jᵀC f_j
    residual_rows = inverse_factor.T @ whitened_products
    information_value = jnp.trace(weight) - jnp.sum((inverse_factor @ weight) * inverse_factor)
    return information_value, jnp.sum(residual_rows * (weight @ residual_rows), axis=0)  # f_jᵀCVC f_j


def _inverse_factor(gram_matrix: Float[Array, "s s"]) -> Float[Array, "s s"]:
    """Inverse L⁻¹ of the Cholesky factor of I + `gram_matrix`. Only matrix products are used, which can always be
    batched, unlike LAPACK's solvers."""
    return inverse_cholesky(jnp.eye(len(gram_matrix)) + gram_matrix[None])[0]


@partial(jax.jit, static_argnames=("number", "criterion", "iterations"))
def _relaxed_bound(candidates: Candidates, number: int, criterion: Criterion, iterations: int):
    def improve_fractions(step_index, bound_state):
        measured_fractions, information_bound = bound_state
        information_value, information_slope = _information_and_slope(candidates, measured_fractions, criterion)
        _, best_candidates = jax.lax.top_k(information_slope, number)
        vertex_fractions = jnp.zeros_like(measured_fractions).at[best_candidates].set(1.0)
        information_bound = jnp.minimum(
            information_bound, information_value + information_slope @ (vertex_fractions - measured_fractions)
        )
        return measured_fractions + 2 / (step_index + 2) * (vertex_fractions - measured_fractions), information_bound

    initial_fractions = jnp.full(candidates.num_candidates, number / candidates.num_candidates)
    # The Frank-Wolfe step size is 2 / (k + 2) at step k. The loop starts at k = 2, with a step size of 1/2, since the
    # full step at k = 0 would discard the initial fractions.
    return jax.lax.fori_loop(2, iterations + 2, improve_fractions, (initial_fractions, jnp.array(jnp.inf)))[1]
