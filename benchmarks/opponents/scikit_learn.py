"""scikit-learn's k-means, on one thread, which is fastest at this size."""

from __future__ import annotations

import statistics

import numpy as np

from benchmarks.harness.timing import Timed, timed


def kmeans(vectors: np.ndarray, number: int, rounds: int, draws: int) -> tuple[Timed, float]:
    """Time k-means with `number` clusters of vectors (n, d) and 10 restarts; also return the median inertia of several
    runs."""
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        spent = timed(lambda: KMeans(number, n_init=10, random_state=0).fit(vectors), rounds)
        found = [KMeans(number, n_init=10, random_state=k).fit(vectors).inertia_ for k in range(draws)]
    return spent, statistics.median(found)
