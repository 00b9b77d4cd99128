"""Regressors of numbers, places or forces, from features.

Each takes features (N, k) and standardised targets (N, d), and returns an object with `predict(features)`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jeit.touch.kohonen.placed_map import PlacedMap
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap
from jeit.touch.kohonen.training import Schedule
from jeit.touch.learnt.forest import Forest
from jeit.touch.learnt.gaussian_process import GaussianProcess
from jeit.touch.learnt.nearest import Nearest
from jeit.touch.learnt.network import Network

_ALPHAS = np.logspace(-2, 5, 15)
_TREES = 100
# The number of times that each of few presses is presented to a map, in each phase.
_SHOWN = 50


def ridge(features, targets) -> Any:
    """Fit ridge regression, with the penalty that generalised cross-validation chooses."""
    from sklearn.linear_model import RidgeCV

    return RidgeCV(_ALPHAS).fit(features, targets)


def trees(features, targets) -> Any:
    """Fit gradient-boosted trees, a sequence for each target."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    options = {"max_iter": 100, "max_leaf_nodes": 15, "min_samples_leaf": 8, "l2_regularization": 1.0}
    models = [HistGradientBoostingRegressor(random_state=0, **options).fit(features, one) for one in targets.T]
    return Forest.of_boosted(models)


def forest(features, targets) -> Any:
    """Fit trees with random splits, averaged (Geurts et al. 2006)."""
    from sklearn.ensemble import ExtraTreesRegressor

    targets = targets[:, 0] if targets.shape[1] == 1 else targets
    found = ExtraTreesRegressor(_TREES, max_features=0.3, min_samples_leaf=2, random_state=0).fit(features, targets)
    return Forest.of_averaged(found.estimators_)


def som(features, targets) -> Any:
    """Fit Kohonen's map, whose neurons have the targets of the presses that each won, and values between them."""
    import jax

    shown = min(Schedule().ordering, _SHOWN * len(features))
    learnt = SelfOrganisingMap.fit(features, jax.random.key(0), schedule=Schedule(shown, shown))
    return PlacedMap.learn(learnt, features, targets)


REGRESSORS: dict[str, Callable[..., Any]] = {
    "ridge": ridge,
    "neighbours": Nearest.of_numbers,
    "gaussian-process": GaussianProcess.fit,
    "trees": trees,
    "forest": forest,
    "network": Network.train,
    "som": som,
}
# Methods that are quick enough to be tried on every form of the features.
QUICK = ("ridge", "neighbours")
# Methods that select few informative channels: they are applied to channels, not to their principal components.
OF_CHANNELS = ("forest",)
