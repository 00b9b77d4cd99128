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
    number = np.shape(points)[0]
    _check_count("num_clusters", num_clusters)
    _check_count("restarts", restarts)
    _check_count("max_steps", max_steps)
    if num_clusters > number:
        raise ValueError(f"num_clusters is {num_clusters}, but there are only {number} points; ask for fewer clusters.")
    if has_values(tolerance) and not 0 <= tolerance < 1:
        raise ValueError(f"tolerance must be a share of the inertia, from 0 and less than 1; it is {tolerance!r}.")
    if not isinstance(key, (jax.Array, np.ndarray)):
        raise ValueError(f"key is {key!r}; give a key of jax.random, such as jax.random.key(0).")
    if has_values(points) and not (finite := np.isfinite(points).all(axis=1)).all():
        raise ValueError(f"points: {(~finite).sum()} of {number} are NaN or infinite; leave them out.")
    return _kmeans(jnp.asarray(points, float), key, (max_steps, jnp.asarray(tolerance)), num_clusters, restarts)


def _check_count(name: str, count: int) -> None:
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise ValueError(f"{name} must be a whole number from 1; it is {count!r}.")


@partial(jax.jit, static_argnums=(3, 4))
def _kmeans(points, key, stopping_criteria: tuple[Any, Any], num_clusters: int, restarts: int) -> KMeans:
    # Labels have no derivative. The derivative of the means for constant labels needs no loop.
    find_best_restart = in_turn(partial(_best_restart, num_clusters, restarts))
    best_state = find_best_restart(jax.lax.stop_gradient(points), key, stopping_criteria)
    centres = _cluster_means(points, best_state.labels, best_state.centres)
    return KMeans(
        centres=centres,
        labels=best_state.labels,
        inertia=jnp.sum((points - centres[best_state.labels]) ** 2),
        steps=best_state.steps,
        converged=best_state.is_converged,
    )


class _State(Module):
    """State of Lloyd's algorithm. `labels`: nearest centre of each point; `distance` (n,): squared distance from this
    centre."""

    centres: Float[Array, "k d"]
    labels: Int[Array, " n"]
    distance: Float[Array, " n"]
    inertia: Float[Array, ""]
    steps: Int[Array, ""]
    is_converged: Bool[Array, ""]


def _best_restart(num_clusters: int, restarts: int, points, key, stopping_criteria) -> _State:
    """Result of the restart with the smallest inertia. `stopping_criteria`: maximum number of steps, and tolerance."""
    mean = jnp.mean(points, axis=0)
    centred = points - mean
    squares = jnp.sum(centred**2, axis=1)
    # The choice of initial centres takes the same number of steps for all starts, so all starts run in parallel and
    # share each read of the points. The number of Lloyd iterations differs between starts, so the iterations run one
    # start after the other, and no start waits for the slowest.
    draws = jax.random.uniform(key, (restarts, num_clusters, _num_candidates(num_clusters)), points.dtype)
    starts = jax.vmap(lambda draws: _kmeans_plus_plus(centred, squares, draws))(draws)
    minimise_inertia = in_turn(_lloyd)
    final_states = jax.vmap(lambda start: minimise_inertia(start, centred, squares, stopping_criteria))(starts)
    best_final_state = jax.tree.map(lambda array: array[jnp.argmin(final_states.inertia)], final_states)
    return eqx.tree_at(lambda state: state.centres, best_final_state, best_final_state.centres + mean)


def _num_candidates(num_clusters: int) -> int:
    """Number of points drawn as candidates for every centre of a start, as in scikit-learn."""
    return 2 + int(np.log(num_clusters))


def _kmeans_plus_plus(points, squares, random_numbers: Float[Array, "k trials"]) -> Float[Array, "k d"]:
    """Greedy k-means++: a few points are drawn with probabilities proportional to their squared distance to the nearest
    centre. The next centre is the drawn point that lowers the sum of the squared distances most. `random_numbers`:
    random numbers from 0 to 1."""
    last_index = len(points) - 1

    def squared_distances(point_indices):
        return jnp.maximum(squares[point_indices][:, None] - 2 * points[point_indices] @ points.T + squares, 0)

    def add_centre(nearest_distances, random_numbers):
        cumulative_weights = jnp.cumsum(nearest_distances)
        candidates = jnp.searchsorted(
            cumulative_weights, random_numbers * cumulative_weights[-1], side="right", method="compare_all"
        )
        candidates = jnp.minimum(candidates, last_index)
        distances_with_candidates = jnp.minimum(nearest_distances, squared_distances(candidates))
        best_index = jnp.argmin(jnp.sum(distances_with_candidates, axis=1))
        return distances_with_candidates[best_index], candidates[best_index]

    first_index = jnp.minimum((random_numbers[0, :1] * len(points)).astype(int), last_index)
    _, other_indices = jax.lax.scan(add_centre, squared_distances(first_index)[0], random_numbers[1:])
    return points[jnp.concatenate([first_index, other_indices])]


def _lloyd(start, points, squares, stopping_criteria) -> _State:
    """Alternate between computing the means of the clusters and assigning points to the nearest means, until nothing
    changes. `stopping_criteria`: maximum number of steps, and tolerance."""
    num_clusters = len(start)
    max_steps, tolerance = stopping_criteria
    max_moved = -(-num_clusters // 3)

    def compute_scores(centres):
        """Squared distances between `centres` and points, minus the squared norms of the points."""
        return jnp.sum(centres**2, axis=1)[:, None] - 2 * centres @ points.T

    def update_scores(scores, centres, is_moved_centre):
        """Update the scores of the centres that moved. After a few steps most centres do not move, and their scores do
        not change."""

        def score_moved_centres():
            centre_indices = jnp.nonzero(is_moved_centre, size=max_moved, fill_value=num_clusters)[0]
            return scores.at[centre_indices].set(
                compute_scores(jnp.take(centres, centre_indices, axis=0, mode="clip")), mode="drop"
            )

        return jax.lax.cond(jnp.sum(is_moved_centre) <= max_moved, score_moved_centres, lambda: compute_scores(centres))

    def assign(scores):
        """Labels, distances and inertia for the nearest centres; of several equally near centres the first is used.
        Computed with a minimum, which is many times faster than jnp.argmin on a CPU."""
        min_scores = jnp.min(scores, axis=0)
        rows = jnp.arange(num_clusters)[:, None]
        labels = jnp.min(jnp.where(scores == min_scores, rows, num_clusters - 1), axis=0)
        distances = jnp.maximum(min_scores + squares, 0)
        return labels, distances, jnp.sum(distances)

    def step(loop):
        state, scores = loop
        counts = _cluster_sizes(state.labels, num_clusters)
        labels = jax.lax.cond(
            jnp.all(counts > 0),
            lambda: state.labels,
            lambda: _fill_empty_clusters(state.labels, state.distance, counts),
        )
        centres = _cluster_means(points, labels, state.centres)
        scores = update_scores(scores, centres, jnp.any(centres != state.centres, axis=1))
        labels, distances, inertia = assign(scores)
        has_converged = jnp.all(labels == state.labels) | (state.inertia - inertia <= tolerance * state.inertia)
        return _State(centres, labels, distances, inertia, state.steps + 1, has_converged), scores

    def is_unfinished(loop):
        return ~loop[0].is_converged & (loop[0].steps < max_steps)

    scores = compute_scores(start)
    initial_state = _State(start, *assign(scores), jnp.zeros((), int), jnp.zeros((), bool))
    return jax.lax.while_loop(is_unfinished, step, (initial_state, scores))[0]


def _fill_empty_clusters(labels, distance, counts) -> Int[Array, " n"]:
    """Assign the points that lie farthest from their centres to the empty clusters, and return the new labels."""
    is_empty = counts == 0
    distances_in_large_clusters = jnp.where(counts[labels] > 1, distance, -1)
    farthest_points = jax.lax.top_k(distances_in_large_clusters, len(counts))[1]
    moved_points = jnp.where(is_empty, farthest_points[jnp.cumsum(is_empty) - 1], len(labels))
    return labels.at[moved_points].set(jnp.arange(len(counts)), mode="drop")


def _cluster_sizes(labels, num_clusters: int) -> Int[Array, " k"]:
    return jax.ops.segment_sum(jnp.ones_like(labels), labels, num_clusters)


def _cluster_means(points, labels, default_means) -> Float[Array, "k d"]:
    """Mean of the points of each cluster; for empty clusters the rows of `default_means` (k, d)."""
    num_clusters = len(default_means)

    def sum_by_scattering(points, labels):
        return jax.ops.segment_sum(points, labels, num_clusters)

    def sum_by_product(points, labels):
        return jax.nn.one_hot(labels, num_clusters, dtype=points.dtype, axis=0) @ points

    # On a CPU a sum by index costs a fifth of the product; on accelerators the order of such a sum, and so its
    # rounding, is random.
    totals = jax.lax.platform_dependent(points, labels, cpu=sum_by_scattering, default=sum_by_product)
    counts = _cluster_sizes(labels, num_clusters)[:, None]
    return jnp.where(counts > 0, totals / jnp.maximum(counts, 1), default_means)
