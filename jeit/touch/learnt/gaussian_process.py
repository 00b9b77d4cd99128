"""Gaussian-process regression: smooth functions of the features, with few centres where presses are many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from jeit.touch.learnt.extras import in_parts

# The number of presses from which length and noise are estimated; the greatest number of centres (all presses, if there
# are no more).
_TUNED_ON, _CENTRES = 400, 640
_AT_ONCE = 512


@dataclass(frozen=True)
class GaussianProcess:
    """A Gaussian process: Σ `weights` (m, d) × kernel of the distance from `centres` (m, k), in `length`s.

    The kernel is Matérn's of order 3/2, (1 + √3 r) e^(−√3 r). Length and noise maximise the marginal likelihood,
    Rasmussen and Williams (2006), eq. 5.8; where there are fewer centres than presses, the method is the subset of
    regressors, section 8.3.1.
    """

    centres: Float[np.ndarray, "m k"]
    weights: Float[np.ndarray, "m d"]
    length: float

    @classmethod
    def fit(cls, features, targets) -> "GaussianProcess":
        """Fit standardised `targets` (N, d) to `features` (N, k)."""
        order = np.random.default_rng(0).permutation(len(features))
        some = order[:_TUNED_ON]
        length, noise = _tuned(features[some], targets[some])
        chosen = np.sort(order[:_CENTRES])
        centres = features[chosen]
        among = _kernel(cdist(centres, centres) / length)
        if len(centres) == len(features):
            matrix, load = among + noise * np.eye(len(among)), targets[chosen]
        else:
            across = _kernel(cdist(features, centres) / length)
            matrix, load = across.T @ across + noise * among, across.T @ targets
            matrix += 1e-8 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
        return cls(centres, cho_solve(cho_factor(matrix), load), length)

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict targets (n, d)."""
        scaled = self.centres / self.length
        squares = np.sum(scaled**2, axis=1)

        def means(some: np.ndarray) -> np.ndarray:
            some = some / self.length
            squared = np.sum(some**2, axis=1)[:, None] + squares - 2 * some @ scaled.T
            return _kernel(np.sqrt(np.maximum(squared, 0.0))) @ self.weights

        return in_parts(means, features, _AT_ONCE)


def _kernel(distance: np.ndarray) -> np.ndarray:
    scaled = np.sqrt(3.0) * distance
    return (1 + scaled) * np.exp(-scaled)


def _tuned(features: np.ndarray, targets: np.ndarray) -> tuple[float, float]:
    """Estimate the length, and the ratio of the noise's variance to that of the function, whose own variance is solved
    for."""
    apart = cdist(features, features)
    usual = float(np.sqrt(np.mean(apart**2))) or 1.0

    def unlikelihood(logs: np.ndarray) -> float:
        matrix = _kernel(apart / (usual * np.exp(logs[0]))) + np.exp(logs[1]) * np.eye(len(apart))
        try:
            factor = cho_factor(matrix, lower=True)
        except np.linalg.LinAlgError:
            return 1e12
        size = np.mean(np.sum(targets * cho_solve(factor, targets), axis=0) / len(targets))
        return float(2 * np.sum(np.log(np.diag(factor[0]))) + len(targets) * np.log(max(size, 1e-300)))

    bounds = [(np.log(0.05), np.log(50.0)), (np.log(1e-6), np.log(1e3))]
    starts = [(0.5, np.log(0.05)), (2.0, np.log(0.3))]
    tuned = min(
        (
            minimize(unlikelihood, start, method="Nelder-Mead", bounds=bounds, options={"maxfev": 60})
            for start in starts
        ),
        key=lambda found: found.fun,
    )
    return usual * float(np.exp(tuned.x[0])), float(np.exp(tuned.x[1]))
