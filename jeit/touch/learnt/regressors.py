"""Methods that learn numbers, places or forces, from features.

Each takes features (N, k) and standardised targets (N, d), and gives what has `predict(features)`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from jeit.touch.learnt.forest import Forest
from jeit.touch.learnt.gaussian_process import GaussianProcess
from jeit.touch.learnt.nearest import Nearest
from jeit.touch.learnt.network import Network

_ALPHAS = np.logspace(-2, 5, 15)
_TREES = 100


def ridge(features, targets) -> Any:
    """Linear, with the penalty that generalised cross-validation chooses."""
    from sklearn.linear_model import RidgeCV

    return RidgeCV(_ALPHAS).fit(features, targets)


def trees(features, targets) -> Any:
    """Gradient-boosted trees, a sequence for each target."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    options = {"max_iter": 100, "max_leaf_nodes": 15, "min_samples_leaf": 8, "l2_regularization": 1.0}
    models = [HistGradientBoostingRegressor(random_state=0, **options).fit(features, one) for one in targets.T]
    return Forest.of_boosted(models)


def forest(features, targets) -> Any:
    """Trees with random splits, averaged (Geurts et al. 2006)."""
    from sklearn.ensemble import ExtraTreesRegressor

    targets = targets[:, 0] if targets.shape[1] == 1 else targets
    found = ExtraTreesRegressor(_TREES, max_features=0.3, min_samples_leaf=2, random_state=0).fit(features, targets)
    return Forest.of_averaged(found.estimators_)


REGRESSORS: dict[str, Callable[..., Any]] = {
    "ridge": ridge,
    "neighbours": Nearest.of_numbers,
    "gaussian-process": GaussianProcess.fit,
    "trees": trees,
    "forest": forest,
    "network": Network.train,
}
# Quick enough to be tried on every form of the features.
QUICK = ("ridge", "neighbours")
# Those that look for the few channels that tell: asked of channels, not of their principal components.
OF_CHANNELS = ("forest",)
