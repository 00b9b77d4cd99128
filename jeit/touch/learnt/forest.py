"""Decision trees as arrays, all evaluated in parallel: scikit-learn takes milliseconds for one frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jeit.touch.learnt.extras import in_parts

# The number of frames evaluated at once, so that the data stay in the cache.
_AT_ONCE = 128


@dataclass(frozen=True)
class Forest:
    """T decision trees of up to n nodes.

    `feature` (T, n) and `threshold` (T, n) of each node; `left` and `right` (T, n): the next nodes where the feature is
    not above the threshold, and where it is; leaves lead to themselves. `value` (T, n, d) of leaves: the sum of these
    and `start` (d,) are the answer. `depth`: the number of steps to a leaf. `classes_` (d,), for classifiers.
    """

    feature: Int[np.ndarray, "T n"]
    threshold: Float[np.ndarray, "T n"]
    left: Int[np.ndarray, "T n"]
    right: Int[np.ndarray, "T n"]
    value: Float[np.ndarray, "T n d"]
    depth: int
    start: Float[np.ndarray, " d"]
    classes_: np.ndarray

    def __post_init__(self):
        """Check the depth. Raises `ValueError` for a depth that trees of so many nodes do not have."""
        if not 0 <= self.depth <= self.value.shape[1]:
            raise ValueError(f"depth is {self.depth}, of trees of {self.value.shape[1]} nodes.")

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Sum of the trees' values."""
        trees, size, targets = self.value.shape
        first_node = size * np.arange(trees)
        # Nodes are numbered throughout, and all arrays flat: `take` is faster than indexing two axes.
        feature, threshold = self.feature.ravel(), self.threshold.ravel()
        below, above = ((one + first_node[:, None]).ravel() for one in (self.left, self.right))
        value = self.value.reshape(-1, targets)

        def answer(some: np.ndarray) -> np.ndarray:
            row = (some.shape[1] * np.arange(len(some)))[:, None]
            flat = np.ascontiguousarray(some).ravel()
            node = np.broadcast_to(first_node, (len(some), trees))
            for _ in range(self.depth):
                further = flat.take(row + feature.take(node)) > threshold.take(node)
                node = np.where(further, above.take(node), below.take(node))
            return value.take(node, axis=0).sum(axis=1)

        return in_parts(answer, features, _AT_ONCE) + self.start

    def decision_function(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """For classifiers: the trees' votes for each class."""
        return self.predict(features)

    @classmethod
    def of_boosted(cls, models: list[Any]) -> "Forest":
        """Convert scikit-learn's histogram gradient boosting, one model for each of d targets."""
        trees = []
        for target, model in enumerate(models):
            for (one,) in model._predictors:
                nodes = one.nodes
                value = np.zeros((len(nodes), len(models)))
                value[:, target] = nodes["value"]
                leaf = nodes["is_leaf"].astype(bool)
                trees.append((nodes["feature_idx"], nodes["num_threshold"], nodes["left"], nodes["right"], leaf, value))
        start = np.array([float(np.ravel(model._baseline_prediction)[0]) for model in models])
        return cls._joined(trees, start, np.arange(len(models)))

    @classmethod
    def of_boosted_classes(cls, model: Any) -> "Forest":
        """Convert scikit-learn's histogram gradient boosting classifier, to log-odds of its classes.

        Of two classes, the second has half of the model's log-odds, and the first the same with a negative sign.
        """
        trees, number = [], len(model.classes_)
        for one in model._predictors:
            for target, tree in enumerate(one):
                nodes = tree.nodes
                own = np.array([-0.5, 0.5]) if number == 2 else np.eye(number)[target]
                leaf = nodes["is_leaf"].astype(bool)
                value = np.outer(nodes["value"], own)
                trees.append((nodes["feature_idx"], nodes["num_threshold"], nodes["left"], nodes["right"], leaf, value))
        start = np.ravel(model._baseline_prediction).astype(float)
        start = np.array([-0.5, 0.5]) * start[0] if number == 2 else start
        return cls._joined(trees, start, model.classes_)

    @classmethod
    def of_averaged(cls, models: list[Any]) -> "Forest":
        """Convert scikit-learn's regression trees, whose mean is taken."""
        trees = []
        for model in models:
            one = model.tree_
            leaf = one.children_left < 0
            value = one.value[:, :, 0] / len(models)
            trees.append((one.feature, one.threshold, one.children_left, one.children_right, leaf, value))
        targets = trees[0][-1].shape[1]
        return cls._joined(trees, np.zeros(targets), np.arange(targets))

    @classmethod
    def of_trees(cls, models: list[Any], weights: np.ndarray, classes: np.ndarray, *, votes: bool) -> "Forest":
        """Convert scikit-learn's classification trees: their leaves' class shares, or whole `votes`, weighted."""
        trees = []
        for model, weight in zip(models, weights, strict=True):
            one = model.tree_
            share = one.value[:, 0] / one.value[:, 0].sum(axis=1, keepdims=True)
            if votes:
                share = np.eye(share.shape[1])[share.argmax(axis=1)]
            value = np.zeros((len(share), len(classes)))
            value[:, model.classes_.astype(int)] = weight * share
            leaf = one.children_left < 0
            trees.append((one.feature, one.threshold, one.children_left, one.children_right, leaf, value))
        return cls._joined(trees, np.zeros(len(classes)), classes)

    @classmethod
    def of_stumps(cls, model: Any) -> "Forest":
        """Convert a `LogitBoostClassifier`: a tree for each stump, with its contribution to all classes."""
        rounds, number = model.feature_.shape
        trees = []
        for one, kind in np.ndindex(rounds, number):
            own = np.eye(number)[kind] - 1 / number
            said = np.outer([0.0, model.below_[one, kind], model.above_[one, kind]], own)
            asked, at = np.array([model.feature_[one, kind], 0, 0]), np.array([model.threshold_[one, kind], 0.0, 0.0])
            trees.append((asked, at, np.array([1, 1, 2]), np.array([2, 1, 2]), np.array([False, True, True]), said))
        return cls._joined(trees, np.zeros(number), model.classes_)

    @classmethod
    def _joined(cls, trees: list[tuple], start: np.ndarray, classes: np.ndarray) -> "Forest":
        most, depth = max(len(tree[0]) for tree in trees), 1
        feature, left, right = (np.zeros((len(trees), most), np.int32) for _ in range(3))
        threshold = np.zeros((len(trees), most))
        value = np.zeros((len(trees), most, len(start)))
        for number, (asked, at, below, above, leaf, said) in enumerate(trees):
            size, itself = len(asked), np.arange(len(asked))
            feature[number, :size] = np.where(leaf, 0, asked)
            threshold[number, :size] = np.where(leaf, 0.0, at)
            left[number, :size] = np.where(leaf, itself, below)
            right[number, :size] = np.where(leaf, itself, above)
            value[number, :size] = said
            level = np.zeros(size, int)
            for node in itself[~leaf]:  # parents come before their children
                level[[left[number, node], right[number, node]]] = level[node] + 1
            depth = max(depth, int(level.max()))
        return cls(feature, threshold, left, right, value, depth, start, classes)
