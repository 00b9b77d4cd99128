"""k-means clustering by matrix products.

Lloyd's algorithm is run from several greedy k-means++ starts. For k clusters of n points in d dimensions, the main cost
of an iteration is the product of a matrix (k, d) with a matrix (d, n). The product is smaller once some centres no
longer move. The mean of the points is subtracted first: the squared distance ‖x‖² - 2 x·c + ‖c‖² of a point x from a
centre c would be inaccurate far from the origin.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jeit_solvers.engines import has_values, in_turn
from jeit_solvers.module import Module


class KMeans(Module):
    """Result of k-means.

    **Fields**: `centres`: (k, d) means of the clusters; `labels`: (n,) cluster of each point; `inertia`: sum of the
    squared distances of the points from the centres of their clusters; `steps`: number of iterations of the best
    restart; `converged`: whether the best restart converged.

    **Example:**

    ```python
    found = kmeans(jax.random.normal(jax.random.key(0), (100, 2)), 3, jax.random.key(1))
    found.centres, found.labels
    ```
    """

    centres: Float[Array, "k d"]
    labels: Int[Array, " n"]
    inertia: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def kmeans(
    points: Float[Array, "n d"],
    num_clusters: int,
    key: Any,
    *,
    restarts: int = 10,
    max_steps: int = 300,
    tolerance: float = 0.0,
) -> KMeans:
    """Partition points into k clusters of minimum inertia (sum of squared distances from the centres), by k-means: the
    best of several local minima.

    Lloyd's algorithm (IEEE Trans. Inf. Theory 28, 1982) is run from greedy k-means++ starts (Arthur and Vassilvitskii
    2007). Clusters that lose all points receive the points farthest from their centres; a cluster can remain empty only
    if fewer than k points differ. Batches of point sets are supported through `jax.vmap`. Derivatives of the centres
    and of the inertia treat the labels as constant.

    **Arguments:**

    - `points` (n, d): the points.
    - `num_clusters`: k.
    - `key`: random key from `jax.random.key`; the same key gives the same clusters.
    - `restarts`: number of starts.
    - `max_steps`: maximum number of iterations of Lloyd's algorithm for each start.
    - `tolerance`: stop when an iteration lowers the inertia by no more than this fraction of the inertia; with 0,
      iterate until no point changes its cluster.

    Raises `ValueError` for invalid shapes, counts, tolerances, keys and points.

    **Example:**

    ```python
    found = kmeans(jax.random.normal(jax.random.key(0), (100, 2)), 3, jax.random.key(1))
    ```
    """
    if np.ndim(points) != 2 or 0 in np.shape(points):
        raise ValueError(f"points has shape {np.shape(points)}; give (n, d), one row for each point.")
    if jnp.iscomplexobj(points):
        raise ValueError("points are complex; give their real and imaginary parts as separate columns.")
    num_points = np.shape(points)[0]
    _check_count("num_clusters", num_clusters)
    _check_count("restarts", restarts)
    _check_count("max_steps", max_steps)
    if num_clusters > num_points:
        raise ValueError(
            f"num_clusters is {num_clusters}, but there are only {num_points} points; ask for fewer clusters."
        )
    if has_values(tolerance) and not 0 <= tolerance < 1:
        raise ValueError(f"tolerance must be a share of the inertia, from 0 and less than 1; it is {tolerance!r}.")
    if not isinstance(key, (jax.Array, np.ndarray)):
        raise ValueError(f"key is {key!r}; give a key of jax.random, such as jax.random.key(0).")
    if has_values(points) and not (is_finite_point := np.isfinite(points).all(axis=1)).all():
        raise ValueError(f"points: {(~is_finite_point).sum()} of {num_points} are NaN or infinite; leave them out.")
    return _compiled_kmeans(
        jnp.asarray(points, float), key, (max_steps, jnp.asarray(tolerance)), num_clusters, restarts
    )


def _check_count(name: str, cluster_count: int) -> None:
    if isinstance(cluster_count, bool) or not isinstance(cluster_count, (int, np.integer)) or cluster_count < 1:
        raise ValueError(f"{name} must be a whole number from 1; it is {cluster_count!r}.")


@partial(jax.jit, static_argnums=(3, 4))
def _compiled_kmeans(
    points, random_key, stopping_criteria: tuple[Any, Any], num_clusters: int, num_restarts: int
) -> KMeans:
    # Labels have no derivative. The derivative of the means for constant labels needs no loop.
    find_best_restart = in_turn(partial(_best_restart, num_clusters, num_restarts))
    best_state = find_best_restart(jax.lax.stop_gradient(points), random_key, stopping_criteria)
    final_centres = _cluster_means(points, best_state.labels, best_state.centres)
    return KMeans(
        centres=final_centres,
        labels=best_state.labels,
        inertia=jnp.sum((points - final_centres[best_state.labels]) ** 2),
        steps=best_state.num_steps,
        converged=best_state.is_converged,
    )


class _LloydState(Module):
    """State of Lloyd's algorithm. `labels`: nearest centre of each point; `squared_distances` (n,) from this
    centre."""

    centres: Float[Array, "k d"]
    labels: Int[Array, " n"]
    squared_distances: Float[Array, " n"]
    inertia: Float[Array, ""]
    num_steps: Int[Array, ""]
    is_converged: Bool[Array, ""]


def _best_restart(num_clusters: int, num_restarts: int, points, random_key, stopping_criteria) -> _LloydState:
    """Result of the restart with the smallest inertia. `stopping_criteria`: maximum number of steps, and tolerance."""
    mean_point = jnp.mean(points, axis=0)
    centred_points = points - mean_point
    squared_norms = jnp.sum(centred_points**2, axis=1)
    # The choice of initial centres takes the same number of steps for all starts, so all starts run in parallel and
    # share each read of the points. The number of Lloyd iterations differs between starts, so the iterations run one
    # start after the other, and no start waits for the slowest.
    random_draws = jax.random.uniform(
        random_key, (num_restarts, num_clusters, _num_candidates(num_clusters)), points.dtype
    )
    start_centres = jax.vmap(lambda random_draws: _kmeans_plus_plus(centred_points, squared_norms, random_draws))(
        random_draws
    )
    minimise_inertia = in_turn(_lloyd_iterations)
    final_states = jax.vmap(
        lambda first_centres: minimise_inertia(first_centres, centred_points, squared_norms, stopping_criteria)
    )(start_centres)
    best_final_state = jax.tree.map(
        lambda restart_results: restart_results[jnp.argmin(final_states.inertia)], final_states
    )
    return eqx.tree_at(
        lambda best_restart_state: best_restart_state.centres, best_final_state, best_final_state.centres + mean_point
    )


def _num_candidates(num_clusters: int) -> int:
    """Number of points drawn as candidates for every centre of a start, as in scikit-learn."""
    return 2 + int(np.log(num_clusters))


def _kmeans_plus_plus(points, squared_norms, random_numbers: Float[Array, "k trials"]) -> Float[Array, "k d"]:
    """Greedy k-means++: a few points are drawn with probabilities proportional to their squared distance to the nearest
    centre. The next centre is the drawn point that lowers the sum of the squared distances most. `random_numbers`:
    random numbers from 0 to 1."""
    last_cluster_index = len(points) - 1

    def squared_distances(point_indices):
        return jnp.maximum(
            squared_norms[point_indices][:, None] - 2 * points[point_indices] @ points.T + squared_norms, 0
        )

    def add_centre(nearest_distances, random_numbers):
        cumulative_weights = jnp.cumsum(nearest_distances)
        candidate_indices = jnp.searchsorted(
            cumulative_weights, random_numbers * cumulative_weights[-1], side="right", method="compare_all"
        )
        candidate_indices = jnp.minimum(candidate_indices, last_cluster_index)
        distances_with_candidates = jnp.minimum(nearest_distances, squared_distances(candidate_indices))
        best_candidate_index = jnp.argmin(jnp.sum(distances_with_candidates, axis=1))
        return distances_with_candidates[best_candidate_index], candidate_indices[best_candidate_index]

    first_centre_index = jnp.minimum((random_numbers[0, :1] * len(points)).astype(int), last_cluster_index)
    _, later_centre_indices = jax.lax.scan(add_centre, squared_distances(first_centre_index)[0], random_numbers[1:])
    return points[jnp.concatenate([first_centre_index, later_centre_indices])]


def _lloyd_iterations(start_centres, points, squared_norms, stopping_criteria) -> _LloydState:
    """Alternate between computing the means of the clusters and assigning points to the nearest means, until nothing
    changes. `stopping_criteria`: maximum number of steps, and tolerance."""
    num_clusters = len(start_centres)
    max_steps, inertia_tolerance = stopping_criteria
    max_moved = -(-num_clusters // 3)

    def compute_scores(centres):
        """Squared distances between `centres` and points, minus the squared norms of the points."""
        return jnp.sum(centres**2, axis=1)[:, None] - 2 * centres @ points.T

    def update_scores(centre_scores, new_centres, is_moved_centre):
        """Update the scores of the centres that moved. After a few steps most centres do not move, and their scores do
        not change."""

        def score_moved_centres():
            centre_indices = jnp.nonzero(is_moved_centre, size=max_moved, fill_value=num_clusters)[0]
            return centre_scores.at[centre_indices].set(
                compute_scores(jnp.take(new_centres, centre_indices, axis=0, mode="clip")), mode="drop"
            )

        return jax.lax.cond(
            jnp.sum(is_moved_centre) <= max_moved, score_moved_centres, lambda: compute_scores(new_centres)
        )

    def assign_to_nearest(centre_scores):
        """Labels, distances and inertia for the nearest centres; of several equally near centres the first is used.
        Computed with a minimum, which is many times faster than jnp.argmin on a CPU."""
        min_scores = jnp.min(centre_scores, axis=0)
        centre_rows = jnp.arange(num_clusters)[:, None]
        nearest_labels = jnp.min(jnp.where(centre_scores == min_scores, centre_rows, num_clusters - 1), axis=0)
        point_distances = jnp.maximum(min_scores + squared_norms, 0)
        return nearest_labels, point_distances, jnp.sum(point_distances)

    def lloyd_step(loop_state):
        lloyd_state, centre_scores = loop_state
        cluster_counts = _cluster_sizes(lloyd_state.labels, num_clusters)
        new_labels = jax.lax.cond(
            jnp.all(cluster_counts > 0),
            lambda: lloyd_state.labels,
            lambda: _fill_empty_clusters(lloyd_state.labels, lloyd_state.squared_distances, cluster_counts),
        )
        new_centres = _cluster_means(points, new_labels, lloyd_state.centres)
        centre_scores = update_scores(centre_scores, new_centres, jnp.any(new_centres != lloyd_state.centres, axis=1))
        new_labels, point_distances, new_inertia = assign_to_nearest(centre_scores)
        has_converged = jnp.all(new_labels == lloyd_state.labels) | (
            lloyd_state.inertia - new_inertia <= inertia_tolerance * lloyd_state.inertia
        )
        return _LloydState(
            new_centres, new_labels, point_distances, new_inertia, lloyd_state.num_steps + 1, has_converged
        ), centre_scores

    def is_unfinished(loop_state):
        return ~loop_state[0].is_converged & (loop_state[0].num_steps < max_steps)

    centre_scores = compute_scores(start_centres)
    initial_state = _LloydState(
        start_centres, *assign_to_nearest(centre_scores), jnp.zeros((), int), jnp.zeros((), bool)
    )
    return jax.lax.while_loop(is_unfinished, lloyd_step, (initial_state, centre_scores))[0]


def _fill_empty_clusters(point_labels, squared_distances, cluster_counts) -> Int[Array, " n"]:
    """Assign the points that lie farthest from their centres to the empty clusters, and return the new labels."""
    is_empty = cluster_counts == 0
    distances_in_large_clusters = jnp.where(cluster_counts[point_labels] > 1, squared_distances, -1)
    farthest_points = jax.lax.top_k(distances_in_large_clusters, len(cluster_counts))[1]
    moved_points = jnp.where(is_empty, farthest_points[jnp.cumsum(is_empty) - 1], len(point_labels))
    return point_labels.at[moved_points].set(jnp.arange(len(cluster_counts)), mode="drop")


def _cluster_sizes(point_labels, num_clusters: int) -> Int[Array, " k"]:
    return jax.ops.segment_sum(jnp.ones_like(point_labels), point_labels, num_clusters)


def _cluster_means(points, point_labels, default_means) -> Float[Array, "k d"]:
    """Mean of the points of each cluster; for empty clusters the rows of `default_means` (k, d)."""
    num_clusters = len(default_means)

    def sum_by_scattering(points, point_labels):
        return jax.ops.segment_sum(points, point_labels, num_clusters)

    def sum_by_product(points, point_labels):
        return jax.nn.one_hot(point_labels, num_clusters, dtype=points.dtype, axis=0) @ points

    # On a CPU a sum by index costs a fifth of the product; on accelerators the order of such a sum, and so its
    # rounding, is random.
    cluster_sums = jax.lax.platform_dependent(points, point_labels, cpu=sum_by_scattering, default=sum_by_product)
    cluster_counts = _cluster_sizes(point_labels, num_clusters)[:, None]
    return jnp.where(cluster_counts > 0, cluster_sums / jnp.maximum(cluster_counts, 1), default_means)
