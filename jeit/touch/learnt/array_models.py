"""Decision trees, nearest neighbours and support vector machines stored as arrays, evaluated in microseconds per frame.

Support vector machines have one decision boundary for each pair of classes. The sums over the support vectors are
computed class by class: with thousands of pairs of classes, scikit-learn would take a hundredth of a second for one
frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jeit.touch.learnt.resource_limits import apply_in_parts

# Number of frames evaluated at once, so that the data stay in the processor's cache.
_CHUNK_SIZE = 128


@dataclass(frozen=True)
class Forest:
    """An ensemble of decision trees, stored as arrays.

    `feature` and `threshold` (trees, nodes): index of the feature that each node tests, and the threshold with which
    the feature is compared; `left` and `right` (trees, nodes): index of the next node if the feature is at most the
    threshold, and if it is greater; for leaves, the leaf's own index. `value` (trees, nodes, targets): values of the
    leaves; a prediction is the sum of the values of one leaf of each tree, plus `start` (targets,). `depth`: maximum
    number of steps to a leaf. `classes_`: for classifiers, the class of each target.
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
        """Raises `ValueError` if the depth of the trees is negative or exceeds the number of nodes."""
        if not 0 <= self.depth <= self.value.shape[1]:
            raise ValueError(f"depth is {self.depth}, of trees of {self.value.shape[1]} nodes.")

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict targets (frames, targets): the sum of the trees' values and the constant `start`."""
        num_trees, num_nodes, num_targets = self.value.shape
        first_node_of_tree = num_nodes * np.arange(num_trees)
        # Nodes are numbered consecutively over all trees, and arrays are flat: `take` is faster than indexing two axes.
        node_features, node_thresholds = self.feature.ravel(), self.threshold.ravel()
        left_children, right_children = (
            (child_nodes + first_node_of_tree[:, None]).ravel() for child_nodes in (self.left, self.right)
        )
        node_values = self.value.reshape(-1, num_targets)

        def sum_tree_values(feature_rows: np.ndarray) -> np.ndarray:
            row_starts = (feature_rows.shape[1] * np.arange(len(feature_rows)))[:, None]
            flat_features = np.ascontiguousarray(feature_rows).ravel()
            current_nodes = np.broadcast_to(first_node_of_tree, (len(feature_rows), num_trees))
            for _ in range(self.depth):
                exceeds_threshold = flat_features.take(
                    row_starts + node_features.take(current_nodes)
                ) > node_thresholds.take(current_nodes)
                current_nodes = np.where(
                    exceeds_threshold, right_children.take(current_nodes), left_children.take(current_nodes)
                )
            return node_values.take(current_nodes, axis=0).sum(axis=1)

        return apply_in_parts(sum_tree_values, features, _CHUNK_SIZE) + self.start

    def decision_function(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Compute the score of each class (frames, classes) for a classifier: the sum of the trees' values."""
        return self.predict(features)

    @classmethod
    def from_boosted_regressors(cls, models: list[Any]) -> "Forest":
        """Convert scikit-learn's histogram gradient boosting regressors, one for each target, to one forest."""
        tree_arrays = []
        for target_index, model in enumerate(models):
            for (regressor_tree,) in model._predictors:
                node_table = regressor_tree.nodes
                node_values = np.zeros((len(node_table), len(models)))
                node_values[:, target_index] = node_table["value"]
                is_leaf = node_table["is_leaf"].astype(bool)
                tree_arrays.append(
                    (
                        node_table["feature_idx"],
                        node_table["num_threshold"],
                        node_table["left"],
                        node_table["right"],
                        is_leaf,
                        node_values,
                    )
                )
        baseline_values = np.array([float(np.ravel(model._baseline_prediction)[0]) for model in models])
        return cls._pack_trees(tree_arrays, baseline_values, np.arange(len(models)))

    @classmethod
    def from_boosted_classifier(cls, model: Any) -> "Forest":
        """Convert scikit-learn's histogram gradient boosting classifier to a forest that predicts log-odds.

        With two classes, the score of the second class is half of the model's log-odds; the score of the first is its
        negative.
        """
        tree_arrays, num_classes = [], len(model.classes_)
        for round_trees in model._predictors:
            for class_index, boosted_tree in enumerate(round_trees):
                node_table = boosted_tree.nodes
                class_weights = np.array([-0.5, 0.5]) if num_classes == 2 else np.eye(num_classes)[class_index]
                is_leaf = node_table["is_leaf"].astype(bool)
                node_values = np.outer(node_table["value"], class_weights)
                tree_arrays.append(
                    (
                        node_table["feature_idx"],
                        node_table["num_threshold"],
                        node_table["left"],
                        node_table["right"],
                        is_leaf,
                        node_values,
                    )
                )
        baseline_values = np.ravel(model._baseline_prediction).astype(float)
        baseline_values = np.array([-0.5, 0.5]) * baseline_values[0] if num_classes == 2 else baseline_values
        return cls._pack_trees(tree_arrays, baseline_values, model.classes_)

    @classmethod
    def from_averaged_trees(cls, models: list[Any]) -> "Forest":
        """Convert scikit-learn's regression trees to a forest that predicts the mean of the trees' predictions."""
        tree_arrays = []
        for model in models:
            regression_tree = model.tree_
            is_leaf = regression_tree.children_left < 0
            node_values = regression_tree.value[:, :, 0] / len(models)
            tree_arrays.append(
                (
                    regression_tree.feature,
                    regression_tree.threshold,
                    regression_tree.children_left,
                    regression_tree.children_right,
                    is_leaf,
                    node_values,
                )
            )
        num_targets = tree_arrays[0][-1].shape[1]
        return cls._pack_trees(tree_arrays, np.zeros(num_targets), np.arange(num_targets))

    @classmethod
    def from_classification_trees(
        cls, models: list[Any], weights: np.ndarray, classes: np.ndarray, *, is_voting: bool
    ) -> "Forest":
        """Convert scikit-learn's classification trees to a forest that predicts the weighted sum of the class shares in
        the trees' leaves.

        If `is_voting`, each tree instead gives one weighted vote to the most frequent class of the leaf.
        """
        tree_arrays = []
        for model, tree_weight in zip(models, weights, strict=True):
            classification_tree = model.tree_
            class_fractions = classification_tree.value[:, 0] / classification_tree.value[:, 0].sum(
                axis=1, keepdims=True
            )
            if is_voting:
                class_fractions = np.eye(class_fractions.shape[1])[class_fractions.argmax(axis=1)]
            node_values = np.zeros((len(class_fractions), len(classes)))
            node_values[:, model.classes_.astype(int)] = tree_weight * class_fractions
            is_leaf = classification_tree.children_left < 0
            tree_arrays.append(
                (
                    classification_tree.feature,
                    classification_tree.threshold,
                    classification_tree.children_left,
                    classification_tree.children_right,
                    is_leaf,
                    node_values,
                )
            )
        return cls._pack_trees(tree_arrays, np.zeros(len(classes)), classes)

    @classmethod
    def from_stumps(cls, model: Any) -> "Forest":
        """Convert a `LogitBoostClassifier`: each stump becomes a tree that contributes to the scores of all classes."""
        num_rounds, num_classes = model.feature_.shape
        tree_arrays = []
        for round_index, class_index in np.ndindex(num_rounds, num_classes):
            class_weights = np.eye(num_classes)[class_index] - 1 / num_classes
            leaf_values = np.outer(
                [0.0, model.below_[round_index, class_index], model.above_[round_index, class_index]], class_weights
            )
            tested_features, node_thresholds = (
                np.array([model.feature_[round_index, class_index], 0, 0]),
                np.array([model.threshold_[round_index, class_index], 0.0, 0.0]),
            )
            tree_arrays.append(
                (
                    tested_features,
                    node_thresholds,
                    np.array([1, 1, 2]),
                    np.array([2, 1, 2]),
                    np.array([False, True, True]),
                    leaf_values,
                )
            )
        return cls._pack_trees(tree_arrays, np.zeros(num_classes), model.classes_)

    @classmethod
    def _pack_trees(cls, tree_arrays: list[tuple], constant_values: np.ndarray, classes: np.ndarray) -> "Forest":
        """Create a forest from trees, each a tuple of arrays over its nodes: tested features, thresholds, left and
        right children, whether the node is a leaf, and values."""
        max_nodes, max_depth = max(len(arrays_of_tree[0]) for arrays_of_tree in tree_arrays), 1
        packed_features, packed_left, packed_right = (
            np.zeros((len(tree_arrays), max_nodes), np.int32) for _ in range(3)
        )
        packed_thresholds = np.zeros((len(tree_arrays), max_nodes))
        packed_values = np.zeros((len(tree_arrays), max_nodes, len(constant_values)))
        for tree_index, (tested_features, thresholds, left_children, right_children, is_leaf, node_values) in enumerate(
            tree_arrays
        ):
            num_nodes, node_indices = len(tested_features), np.arange(len(tested_features))
            packed_features[tree_index, :num_nodes] = np.where(is_leaf, 0, tested_features)
            packed_thresholds[tree_index, :num_nodes] = np.where(is_leaf, 0.0, thresholds)
            packed_left[tree_index, :num_nodes] = np.where(is_leaf, node_indices, left_children)
            packed_right[tree_index, :num_nodes] = np.where(is_leaf, node_indices, right_children)
            packed_values[tree_index, :num_nodes] = node_values
            node_levels = np.zeros(num_nodes, int)
            for node_index in node_indices[~is_leaf]:  # parents come before their children
                node_levels[[packed_left[tree_index, node_index], packed_right[tree_index, node_index]]] = (
                    node_levels[node_index] + 1
                )
            max_depth = max(max_depth, int(node_levels.max()))
        return cls(
            packed_features,
            packed_thresholds,
            packed_left,
            packed_right,
            packed_values,
            max_depth,
            constant_values,
            classes,
        )


# Number of frames whose distances from all presses of the training set are computed at once.
_NEIGHBOUR_CHUNK_SIZE = 128
_CANDIDATE_NEIGHBOUR_COUNTS = (3, 5, 8, 12)


@dataclass(frozen=True)
class NearestNeighbours:
    """Nearest-neighbour prediction: the mean target of the `count` nearest presses of the training set, weighted by
    inverse distance between features.

    `features` (presses, features): features of the training presses; `known` (presses, targets): the targets of these
    presses, or for a classifier 1 in the column of each press's class and 0 elsewhere; `classes_`: the class of each
    column.
    """

    features: Float[np.ndarray, "N k"]
    known: Float[np.ndarray, "N d"]
    count: int
    classes_: np.ndarray

    @classmethod
    def fit_regressor(cls, features, targets) -> "NearestNeighbours":
        """Create a regressor of targets (presses, targets), with the number of neighbours that has the lowest
        leave-one-out error."""
        max_neighbours = min(max(_CANDIDATE_NEIGHBOUR_COUNTS), len(features) - 1)
        all_neighbours = cls(features, targets, max_neighbours + 1, np.arange(targets.shape[1]))
        neighbour_distances, neighbour_indices = (
            neighbour_array[:, 1:] for neighbour_array in all_neighbours._nearest_presses(features)
        )
        inverse_distances = 1 / np.maximum(neighbour_distances, 1e-12)[..., None]
        cumulative_means = np.cumsum(inverse_distances * targets[neighbour_indices], axis=1) / np.cumsum(
            inverse_distances, axis=1
        )
        mean_errors = np.linalg.norm(cumulative_means - targets[:, None], axis=-1).mean(axis=0)
        best_count = min(
            [k for k in _CANDIDATE_NEIGHBOUR_COUNTS if k <= max_neighbours] or [max_neighbours],
            key=lambda k: mean_errors[k - 1],
        )
        return cls(features, targets, best_count, all_neighbours.classes_)

    @classmethod
    def fit_classifier(cls, features, label) -> "NearestNeighbours":
        """Create a classifier that predicts the class of the single nearest press."""
        classes = np.unique(label)
        return cls(features, (np.asarray(label)[:, None] == classes).astype(float), 1, classes)

    def predict(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n d"]:
        """Predict targets (frames, targets) from features (frames, features)."""
        neighbour_distances, neighbour_indices = self._nearest_presses(features)
        inverse_distances = 1 / np.maximum(neighbour_distances, 1e-12)
        return np.einsum(
            "nc,ncd->nd",
            inverse_distances / inverse_distances.sum(axis=1, keepdims=True),
            self.known[neighbour_indices],
        )

    def predict_proba(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Predict the weighted share of each class (frames, classes) among the nearest presses."""
        return self.predict(features)

    def _nearest_presses(self, features: np.ndarray) -> tuple[Float[np.ndarray, "n c"], Int[np.ndarray, "n c"]]:
        """Find the nearest training presses of each frame; returns their distances and their indices, both (frames,
        neighbours), the nearest first."""

        def find_nearest(feature_rows: np.ndarray) -> np.ndarray:
            shifted_squares = (-2 * feature_rows) @ self.features.T
            shifted_squares += self._squared_norms  # omits the frame's squared norm, which is the same for all presses
            neighbour_indices = np.argpartition(shifted_squares, self.count - 1, axis=1)[:, : self.count]
            neighbour_distances = np.linalg.norm(self.features[neighbour_indices] - feature_rows[:, None], axis=2)
            sort_order = np.argsort(neighbour_distances, axis=1, kind="stable")
            return np.stack(
                [
                    np.take_along_axis(neighbour_array, sort_order, axis=1)
                    for neighbour_array in (neighbour_distances, neighbour_indices)
                ],
                axis=-1,
            )

        distances_and_indices = apply_in_parts(find_nearest, features, _NEIGHBOUR_CHUNK_SIZE)
        return distances_and_indices[..., 0], distances_and_indices[..., 1].astype(int)

    @cached_property
    def _squared_norms(self) -> Float[np.ndarray, " N"]:
        """Squared Euclidean norm of the features of each training press."""
        return np.sum(self.features**2, axis=1)


@dataclass(frozen=True)
class SupportVectorMachine:
    """A support vector machine with one decision boundary for each pair of classes.

    `support` (vectors, features): support vectors, sorted by class; those of class c are the rows from `start[c]` to
    `start[c + 1]`; `weights` (classes - 1, vectors): weight of each support vector for the boundary with each other
    class; `intercepts`: one for each pair of classes (0, 1), (0, 2), …. The kernel of features x and y is (gain x·y +
    offset)^degree. A linear machine uses the normals of the boundaries instead of the kernel: `slopes` (pairs,
    features).
    """

    support: Float[np.ndarray, "S k"]
    weights: Float[np.ndarray, "D S"]
    start: Int[np.ndarray, " E"]
    intercepts: Float[np.ndarray, " P"]
    gain: float
    offset: float
    degree: int
    slopes: Float[np.ndarray, "P k"] | None
    classes_: np.ndarray

    @classmethod
    def from_scikit_learn(cls, machine) -> "SupportVectorMachine":
        """Convert scikit-learn's support vector classifier with a linear or a polynomial kernel."""
        is_linear = machine.kernel == "linear"
        support_starts = np.concatenate([[0], np.cumsum(machine.n_support_)])
        # In scikit-learn, a positive decision value means the second of two classes; with more than two classes, it
        # means the first class of the pair.
        class_order_sign = -1.0 if len(machine.classes_) == 2 else 1.0
        return cls(
            machine.support_vectors_,
            class_order_sign * machine.dual_coef_,
            support_starts,
            class_order_sign * machine.intercept_,
            1.0 if is_linear else float(machine._gamma),
            0.0 if is_linear else float(machine.coef0),
            1 if is_linear else int(machine.degree),
            class_order_sign * machine.coef_ if is_linear else None,
            machine.classes_,
        )

    def decision_function(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Count the pairwise decisions that each class wins (frames, classes).

        The score includes a term below 1/2, computed from the distances to the decision boundaries, that orders classes
        with equal counts.
        """
        boundary_distances, side_signs = self._boundary_distances(features)
        num_votes = (boundary_distances > 0) @ (side_signs > 0).astype(float) + (boundary_distances <= 0) @ (
            side_signs < 0
        ).astype(float)
        summed_distances = boundary_distances @ side_signs
        return num_votes + summed_distances / (3 * (np.abs(summed_distances) + 1))

    def pair_odds(self, features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n C"]:
        """Compute the score of each class (frames, classes): the sum of its log-probabilities relative to every other
        class.

        The probability of one class relative to another is 1 / (1 + exp(-2 d)) at a distance d from the boundary
        between the two classes, in units of its margin. Unlike the numbers of won decisions, these sums measure
        confidence.
        """
        boundary_distances, side_signs = self._boundary_distances(features)
        log_probabilities_won, log_probabilities_lost = (
            -np.logaddexp(0.0, -2 * boundary_distances),
            -np.logaddexp(0.0, 2 * boundary_distances),
        )
        return log_probabilities_won @ (side_signs > 0).astype(float) + log_probabilities_lost @ (
            side_signs < 0
        ).astype(float)

    def _boundary_distances(self, features: np.ndarray) -> tuple[Float[np.ndarray, "n P"], Float[np.ndarray, "P C"]]:
        """Compute the signed distances (frames, pairs) of features from the decision boundaries of all pairs of
        classes.

        Also returns the sign of the distance on each class's side of a boundary (pairs, classes), 0 for classes that
        are not of the pair.
        """
        num_classes = len(self.classes_)
        first_classes, second_classes = np.triu_indices(num_classes, 1)
        if self.slopes is not None:
            boundary_distances = features @ self.slopes.T + self.intercepts
        else:
            kernel_matrix = (self.gain * features @ self.support.T + self.offset) ** self.degree
            vote_sums = np.empty((len(features), num_classes - 1, num_classes))
            for class_index in range(num_classes):
                class_vectors = slice(self.start[class_index], self.start[class_index + 1])
                vote_sums[:, :, class_index] = kernel_matrix[:, class_vectors] @ self.weights[:, class_vectors].T
            boundary_distances = (
                vote_sums[:, second_classes - 1, first_classes]
                + vote_sums[:, first_classes, second_classes]
                + self.intercepts
            )
        side_signs = np.zeros((len(first_classes), num_classes))
        (
            side_signs[np.arange(len(first_classes)), first_classes],
            side_signs[np.arange(len(first_classes)), second_classes],
        ) = 1.0, -1.0
        return boundary_distances, side_signs
