"""Classifiers of sound windows: a network, boosted trees on hand-made features, and linear discriminants.

One discriminant uses the hand-made features alone, another also the spectrum in all bands. The method `learn` of each
learner returns a classifier. The classifier's method `log_odds` returns the log-odds of the classes 0 … C − 1; its
method `to_stored` returns a header and arrays to store in a file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jeit.touch.learnt.array_models import Forest
from jeit.touch.learnt.methods import CLASSIFIERS
from jeit.touch.learnt.resource_limits import limit_to_one_thread
from jeit.touch.listening.feature_images import SoundImages
from jeit.touch.listening.modality_network import (
    ModalityNetwork,
    NetworkAnswers,
    library_plan,
    paper_plan,
    train_network,
)
from jeit.touch.listening.window_features import Levels, sound_features, spectrum_features
from jeit.touch.training import TrainingPlan

# Number of rounds in which trees are boosted.
_NUM_BOOSTING_ROUNDS = 100
# Number of leaves of a boosted tree.
_NUM_LEAVES = 15
# Minimum number of windows in a leaf of a boosted tree, in large training sets.
_MIN_LEAF_WINDOWS = 10
MAX_TRAINING_BATCHES = 1500
"""Default of the maximum number of training batches."""
# Maximum number of passes through the windows of a small training set.
_MAX_TRAINING_PASSES = 40
# Number of batches that are allowed even if they require more passes.
_MIN_BATCHES = 100
# One in this number of groups of clips of each class is held out for early stopping of the network's training.
_GROUPS_PER_HELD_OUT_GROUP = 6


class TrainingSet(NamedTuple):
    """A training set of sound windows, and the settings of the training.

    `images`: feature images of W windows; `labels` (W,): their true classes, 0 … C − 1; `classes`: the number of
    classes C; `groups` (W,): numbers that are equal for windows recorded together; `key`: random key that draws the
    initial weights of networks; `batches`: maximum number of training batches; `checkpoint`: file in which an
    unfinished training is stored; `progress`: function that is called with a description of the progress.
    """

    images: SoundImages
    labels: Int[np.ndarray, " W"]
    groups: Int[np.ndarray, " W"]
    classes: int
    key: Array
    batches: int = MAX_TRAINING_BATCHES
    checkpoint: Path | None = None
    progress: Callable[[str], None] | None = None


@dataclass(frozen=True)
class NetworkListener:
    """Trained network that classifies sound windows; `levels` converts feature images to its input."""

    network: ModalityNetwork
    levels: Levels
    answers: NetworkAnswers

    @classmethod
    def from_network(cls, network: ModalityNetwork, levels: Levels) -> "NetworkListener":
        """Create a classifier from a trained network and the levels of its input."""
        return cls(network, levels, NetworkAnswers(network))

    def log_odds(self, images: SoundImages) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of C classes for W windows."""
        return self.answers.log_odds(self.levels(images))

    def to_stored(self) -> tuple[dict[str, Any], Any]:
        """Return the header and the arrays to store in a classifier's file."""
        stored_levels = {
            field_name: getattr(self.levels, field_name).tolist() for field_name in Levels.__dataclass_fields__
        }
        return {"levels": stored_levels}, self.network


@dataclass(frozen=True)
class NetworkLearner:
    """Trains a network by the schedule that `plan(windows, batches=)` returns."""

    plan: Callable[..., TrainingPlan]

    def learn(self, training_set: TrainingSet) -> NetworkListener:
        """Train a network with early stopping, by the loss on held-out groups.

        Of the groups of clips of each class, one in six is held out; of three to five groups, one is held out.
        """
        is_held_out = select_early_stopping_windows(training_set.labels, training_set.groups)
        input_levels = Levels.from_images(training_set.images[~is_held_out])
        level_images = input_levels(training_set.images)
        if training_set.checkpoint is not None:
            training_set.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        num_windows = int((~is_held_out).sum())
        max_batches = max(_MIN_BATCHES, _MAX_TRAINING_PASSES * num_windows // 64)
        training_plan = self.plan(num_windows, batches=min(training_set.batches, max_batches))
        training_result = train_network(
            level_images[~is_held_out],
            training_set.labels[~is_held_out],
            (level_images[is_held_out], training_set.labels[is_held_out])
            if is_held_out.any()
            else (level_images, training_set.labels),
            classes=training_set.classes,
            key=training_set.key,
            plan=training_plan,
            checkpoint=training_set.checkpoint,
            progress=training_set.progress,
        )
        return NetworkListener.from_network(training_result.network, input_levels)

    @staticmethod
    def stored_shapes(header: dict[str, Any], classes: int, rows: int) -> Any:
        """Create arrays with the shapes of the arrays in a file with this `header`."""
        return ModalityNetwork.draw(jax.random.key(0), rows, 41, classes)

    @staticmethod
    def from_stored(header: dict[str, Any], arrays: Any) -> NetworkListener:
        """Restore a network from the header and arrays that `NetworkListener.to_stored` returned."""
        return NetworkListener.from_network(
            arrays,
            Levels(**{field_name: np.array(stored_level) for field_name, stored_level in header["levels"].items()}),
        )


@dataclass(frozen=True)
class TreesListener:
    """Classifies sound windows by boosted trees (`HistGradientBoostingClassifier`) on `sound_features`."""

    forest: Forest

    @classmethod
    def learn(cls, training_set: TrainingSet) -> "TreesListener":
        """Fit the trees to a training set; the minimum number of windows in a leaf is lower for small sets."""
        from sklearn.ensemble import HistGradientBoostingClassifier

        min_class_windows = int(np.bincount(training_set.labels, minlength=training_set.classes).min())
        boosted_classifier = HistGradientBoostingClassifier(
            max_iter=_NUM_BOOSTING_ROUNDS,
            max_leaf_nodes=_NUM_LEAVES,
            min_samples_leaf=int(np.clip(min_class_windows // 4, 1, _MIN_LEAF_WINDOWS)),
            l2_regularization=1.0,
            class_weight="balanced",
            early_stopping=False,  # pyright: ignore[reportArgumentType]
            random_state=0,
        )
        with limit_to_one_thread():
            boosted_classifier.fit(sound_features(training_set.images), training_set.labels)
        return cls(Forest.from_boosted_classifier(boosted_classifier))

    def log_odds(self, images: SoundImages) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of C classes for W windows."""
        return self.forest.decision_function(sound_features(images))

    def to_stored(self) -> tuple[dict[str, Any], Any]:
        """Return the header and the arrays to store in a classifier's file."""
        forest = self.forest
        header = {"trees": forest.value.shape[0], "nodes": forest.value.shape[1], "depth": forest.depth}
        forest_arrays = [forest.feature, forest.left, forest.right, forest.threshold, forest.value, forest.start]
        return header, [
            np.asarray(forest_array, np.int32 if array_index < 3 else np.float32)
            for array_index, forest_array in enumerate(forest_arrays)
        ]

    @staticmethod
    def stored_shapes(header: dict[str, Any], classes: int, rows: int) -> Any:
        """Create arrays with the shapes of the arrays in a file with this `header`."""
        node_shape = (int(header["trees"]), int(header["nodes"]))
        array_shapes = [(node_shape, np.int32)] * 3 + [
            (node_shape, np.float32),
            ((*node_shape, classes), np.float32),
            ((classes,), np.float32),
        ]
        return [jax.numpy.zeros(array_shape, dtype) for array_shape, dtype in array_shapes]

    @classmethod
    def from_stored(cls, header: dict[str, Any], arrays: Any) -> "TreesListener":
        """Restore boosted trees from the header and arrays that `to_stored` returned.

        Raises `ValueError` for trees with features or nodes that do not exist.
        """
        split_features, left_children, right_children, split_thresholds, node_values, initial_values = (
            np.asarray(array) for array in arrays
        )
        num_nodes = node_values.shape[1]
        has_valid_features = (
            (split_features >= 0).all() and (split_features < num_features()).all() and 0 < int(header["depth"]) < 1000
        )
        if not (
            has_valid_features
            and all(
                ((child_nodes >= 0) & (child_nodes < num_nodes)).all()
                for child_nodes in (left_children, right_children)
            )
        ):
            raise ValueError("its trees refer to features or nodes that do not exist")
        return cls(
            Forest(
                split_features,
                split_thresholds.astype(float),
                left_children,
                right_children,
                node_values.astype(float),
                int(header["depth"]),
                initial_values.astype(float),
                np.arange(len(initial_values)),
            )
        )


@dataclass(frozen=True)
class LinearListener:
    """Classifies sound windows by a linear discriminant with Ledoit-Wolf shrinkage of the covariance.

    `features` computes k features (W, k) of W windows; `weights` (k, C) and `offset` (C,) apply to features
    standardised by their `mean` (k,) and `deviation` (k,).
    """

    features: Callable[[SoundImages], Float[np.ndarray, "W k"]]
    mean: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, "k C"]
    offset: Float[np.ndarray, " C"]

    def log_odds(self, images: SoundImages) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of C classes for W windows."""
        return (self.features(images) - self.mean) / self.deviation @ self.weights + self.offset

    def to_stored(self) -> tuple[dict[str, Any], Any]:
        """Return the header and the arrays to store in a classifier's file."""
        return {}, [
            np.asarray(model_array, np.float32)
            for model_array in (self.mean, self.deviation, self.weights, self.offset)
        ]


@dataclass(frozen=True)
class LinearLearner:
    """Fits a linear discriminant to the features of sound windows that `features` computes."""

    features: Callable[[SoundImages], Float[np.ndarray, "W k"]]

    def learn(self, training_set: TrainingSet) -> LinearListener:
        """Fit the discriminant to a training set; all classes have the same prior probability, whatever their numbers
        of windows."""
        window_features = self.features(training_set.images)
        feature_means, feature_deviations = window_features.mean(axis=0), window_features.std(axis=0)
        # Features that are constant except for rounding errors carry no information, and would make the covariance
        # singular.
        is_variable_feature = feature_deviations > 1e-5
        feature_deviations = np.where(is_variable_feature, feature_deviations, 1.0)
        discriminant = CLASSIFIERS["linear-discriminant"](
            ((window_features - feature_means) / feature_deviations)[:, is_variable_feature], training_set.labels
        )
        log_priors = np.log(discriminant.priors_)
        class_weights = np.zeros((len(feature_means), len(discriminant.coef_)))
        class_weights[is_variable_feature] = discriminant.coef_.T
        class_offsets = discriminant.intercept_ - (log_priors if len(log_priors) > 2 else log_priors[1] - log_priors[0])
        if class_weights.shape[1] == 1:  # with two classes, scikit-learn stores only the log-odds of the second
            class_weights, class_offsets = (
                np.hstack([-class_weights, class_weights]) / 2,
                np.concatenate([-class_offsets, class_offsets]) / 2,
            )
        return LinearListener(self.features, feature_means, feature_deviations, class_weights, class_offsets)

    def stored_shapes(self, header: dict[str, Any], classes: int, rows: int) -> Any:
        """Create arrays with the shapes of the arrays in a file with this `header`."""
        num_inputs = self.features(_NO_WINDOWS).shape[1]
        return [
            jax.numpy.zeros(array_shape, np.float32)
            for array_shape in ((num_inputs,), (num_inputs,), (num_inputs, classes), (classes,))
        ]

    def from_stored(self, header: dict[str, Any], arrays: Any) -> LinearListener:
        """Restore a discriminant from the header and arrays that `LinearListener.to_stored` returned."""
        return LinearListener(self.features, *(np.asarray(array, float) for array in arrays))


LEARNERS: dict[str, Any] = {
    "paper-network": NetworkLearner(paper_plan),
    "network": NetworkLearner(library_plan),
    "trees": TreesListener,
    "spectrum": LinearLearner(spectrum_features),
    "linear": LinearLearner(sound_features),
}
"""Learners by name. The simplest is last, and is selected among equally accurate ones. The network is trained by the
schedule of the paper, or by that of this library."""


def num_features() -> int:
    """Return the number of hand-made features that `sound_features` computes for a window."""
    return sound_features(_NO_WINDOWS).shape[1]


_NO_WINDOWS = SoundImages(np.zeros(0), np.zeros((0, 1, 41)), np.zeros((0, 64, 41)), np.zeros(0, int), np.zeros(0, bool))


def select_early_stopping_windows(window_classes: Int[np.ndarray, " W"], groups: Int[np.ndarray, " W"]) -> np.ndarray:
    """Return the mask (W,) of the windows that are held out for early stopping: whole groups of clips of each class.

    No group is held out of a class with fewer than three groups.
    """
    is_held_out = np.zeros(len(window_classes), bool)
    held_out_groups: set[int] = set()
    for class_index in np.unique(window_classes):
        class_groups = np.unique(groups[window_classes == class_index])
        num_wanted_groups = (
            len(class_groups) // _GROUPS_PER_HELD_OUT_GROUP
            if len(class_groups) >= _GROUPS_PER_HELD_OUT_GROUP
            else int(len(class_groups) >= 3)
        )
        already_held_out = held_out_groups & set(class_groups.tolist())
        candidate_groups = [group for group in class_groups.tolist() if group not in held_out_groups]
        random_order = np.random.default_rng(int(class_index)).permutation(len(candidate_groups))
        held_out_groups |= {
            candidate_groups[group_index]
            for group_index in random_order[: max(0, num_wanted_groups - len(already_held_out))]
        }
    is_held_out = np.isin(groups, sorted(held_out_groups))
    # If a class would not remain in the training set, nothing is held out.
    return (
        is_held_out
        if set(window_classes[~is_held_out].tolist()) == set(window_classes.tolist())
        else np.zeros(len(window_classes), bool)
    )
