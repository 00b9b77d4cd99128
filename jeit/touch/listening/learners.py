"""Classifiers of sound windows: the network, boosted trees on hand-made features, and linear discriminants.

The discriminants use the hand-made features alone, or with the spectrum in all its bands. The method `learn` of each
learner returns a classifier, which has `log_odds` of the classes 0 … C − 1, and arrays that are stored in a file.
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
from jeit.touch.learnt.extras import one_thread
from jeit.touch.learnt.methods import CLASSIFIERS
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

# Number of boosting rounds; number of leaves of a tree; minimum number of windows in a leaf if the set is large.
_ROUNDS, _LEAVES, _IN_A_LEAF = 100, 15, 10
BATCHES = 1500
"""Default of the maximum number of training batches."""
# Limits for small sets: maximum number of passes through the windows, and the number of batches that are allowed even
# if they make more passes than that.
_MOST_PASSES, _FEWEST = 40, 100
# One in this number of groups of each class is held out for early stopping of the network's training.
_STOPPING = 6


class TrainingSet(NamedTuple):
    """A training set of windows, and the settings of a training.

    `images`: the windows; `right` (W,): their true classes, 0 … C − 1; `classes`: the number of classes C; `groups`
    (W,): numbers that are equal for windows recorded together; `key`: draws the initial weights of networks; `batches`:
    maximum number of training batches; `checkpoint`: file in which an unfinished training is stored; `progress`: is
    called with a description of the progress.
    """

    images: SoundImages
    right: Int[np.ndarray, " W"]
    groups: Int[np.ndarray, " W"]
    classes: int
    key: Array
    batches: int = BATCHES
    checkpoint: Path | None = None
    progress: Callable[[str], None] | None = None


@dataclass(frozen=True)
class NetworkListener:
    """A trained network, and the `levels` that compute its images."""

    network: ModalityNetwork
    levels: Levels
    answers: NetworkAnswers

    @classmethod
    def from_network(cls, network: ModalityNetwork, levels: Levels) -> "NetworkListener":
        """Create a listener from a trained network."""
        return cls(network, levels, NetworkAnswers(network))

    def log_odds(self, images: SoundImages) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of the classes."""
        return self.answers.log_odds(self.levels(images))

    def to_stored(self) -> tuple[dict[str, Any], Any]:
        """Return the header and the arrays to store in a file."""
        levels = {name: getattr(self.levels, name).tolist() for name in Levels.__dataclass_fields__}
        return {"levels": levels}, self.network


@dataclass(frozen=True)
class NetworkLearner:
    """Trains a network by the schedule `plan(windows, batches=)`."""

    plan: Callable[..., TrainingPlan]

    def learn(self, lesson: TrainingSet) -> NetworkListener:
        """Train a network with early stopping, by the loss on held-out groups.

        One in six groups of each class is held out, if it has enough groups.
        """
        held = stopping_rows(lesson.right, lesson.groups)
        levels = Levels.from_images(lesson.images[~held])
        shown = levels(lesson.images)
        if lesson.checkpoint is not None:
            lesson.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        number = int((~held).sum())
        enough = max(_FEWEST, _MOST_PASSES * number // 64)
        plan = self.plan(number, batches=min(lesson.batches, enough))
        trained = train_network(
            shown[~held],
            lesson.right[~held],
            (shown[held], lesson.right[held]) if held.any() else (shown, lesson.right),
            classes=lesson.classes,
            key=lesson.key,
            plan=plan,
            checkpoint=lesson.checkpoint,
            progress=lesson.progress,
        )
        return NetworkListener.from_network(trained.network, levels)

    @staticmethod
    def stored_shapes(head: dict[str, Any], classes: int, rows: int) -> Any:
        """Create arrays with the shapes of the stored ones."""
        return ModalityNetwork.draw(jax.random.key(0), rows, 41, classes)

    @staticmethod
    def from_stored(head: dict[str, Any], arrays: Any) -> NetworkListener:
        """Restore a classifier from the header and arrays of `NetworkListener.to_stored`."""
        return NetworkListener.from_network(
            arrays, Levels(**{name: np.array(value) for name, value in head["levels"].items()})
        )


@dataclass(frozen=True)
class TreesListener:
    """Boosted trees, scikit-learn's `HistGradientBoostingClassifier`, on `sound_features`."""

    forest: Forest

    @classmethod
    def learn(cls, lesson: TrainingSet) -> "TreesListener":
        """Fit the trees; the minimum number of windows in a leaf is lower in small sets."""
        from sklearn.ensemble import HistGradientBoostingClassifier

        fewest = int(np.bincount(lesson.right, minlength=lesson.classes).min())
        model = HistGradientBoostingClassifier(
            max_iter=_ROUNDS,
            max_leaf_nodes=_LEAVES,
            min_samples_leaf=int(np.clip(fewest // 4, 1, _IN_A_LEAF)),
            l2_regularization=1.0,
            class_weight="balanced",
            early_stopping=False,  # pyright: ignore[reportArgumentType]
            random_state=0,
        )
        with one_thread():
            model.fit(sound_features(lesson.images), lesson.right)
        return cls(Forest.from_boosted_classifier(model))

    def log_odds(self, images: SoundImages) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of the classes."""
        return self.forest.decision_function(sound_features(images))

    def to_stored(self) -> tuple[dict[str, Any], Any]:
        """Return the header and the arrays to store in a file."""
        own = self.forest
        head = {"trees": own.value.shape[0], "nodes": own.value.shape[1], "depth": own.depth}
        arrays = [own.feature, own.left, own.right, own.threshold, own.value, own.start]
        return head, [np.asarray(one, np.int32 if place < 3 else np.float32) for place, one in enumerate(arrays)]

    @staticmethod
    def stored_shapes(head: dict[str, Any], classes: int, rows: int) -> Any:
        """Create arrays with the shapes of the stored ones."""
        shape = (int(head["trees"]), int(head["nodes"]))
        shapes = [(shape, np.int32)] * 3 + [
            (shape, np.float32),
            ((*shape, classes), np.float32),
            ((classes,), np.float32),
        ]
        return [jax.numpy.zeros(one, kind) for one, kind in shapes]

    @classmethod
    def from_stored(cls, head: dict[str, Any], arrays: Any) -> "TreesListener":
        """Restore a classifier from the header and arrays of `to_stored`.

        Raises `ValueError` for trees with features or nodes that do not exist.
        """
        feature, left, right, threshold, value, start = (np.asarray(one) for one in arrays)
        nodes = value.shape[1]
        sound = (feature >= 0).all() and (feature < num_features()).all() and 0 < int(head["depth"]) < 1000
        if not (sound and all(((one >= 0) & (one < nodes)).all() for one in (left, right))):
            raise ValueError("its trees refer to features or nodes that do not exist")
        return cls(
            Forest(
                feature,
                threshold.astype(float),
                left,
                right,
                value.astype(float),
                int(head["depth"]),
                start.astype(float),
                np.arange(len(start)),
            )
        )


@dataclass(frozen=True)
class LinearListener:
    """A linear discriminant with Ledoit-Wolf shrinkage of its covariance, on `features` of images.

    `weights` (k, C) and `offset` (C,) apply to features standardised by their `mean` (k,) and `deviation` (k,).
    """

    features: Callable[[SoundImages], Float[np.ndarray, "W k"]]
    mean: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, "k C"]
    offset: Float[np.ndarray, " C"]

    def log_odds(self, images: SoundImages) -> Float[np.ndarray, "W C"]:
        """Compute the log-odds (W, C) of the classes."""
        return (self.features(images) - self.mean) / self.deviation @ self.weights + self.offset

    def to_stored(self) -> tuple[dict[str, Any], Any]:
        """Return the header and the arrays to store in a file."""
        return {}, [np.asarray(one, np.float32) for one in (self.mean, self.deviation, self.weights, self.offset)]


@dataclass(frozen=True)
class LinearLearner:
    """Fits a `LinearListener` to `features` of images."""

    features: Callable[[SoundImages], Float[np.ndarray, "W k"]]

    def learn(self, lesson: TrainingSet) -> LinearListener:
        """Fit the discriminant; all classes have the same prior probability, whatever their number of windows."""
        features = self.features(lesson.images)
        mean, deviation = features.mean(axis=0), features.std(axis=0)
        # Features that are constant except for rounding errors carry no information, and would make the covariance
        # singular.
        varies = deviation > 1e-5
        deviation = np.where(varies, deviation, 1.0)
        model = CLASSIFIERS["linear-discriminant"](((features - mean) / deviation)[:, varies], lesson.right)
        share = np.log(model.priors_)
        weights = np.zeros((len(mean), len(model.coef_)))
        weights[varies] = model.coef_.T
        offset = model.intercept_ - (share if len(share) > 2 else share[1] - share[0])
        if weights.shape[1] == 1:  # two classes: only the log-odds of the second are given
            weights, offset = np.hstack([-weights, weights]) / 2, np.concatenate([-offset, offset]) / 2
        return LinearListener(self.features, mean, deviation, weights, offset)

    def stored_shapes(self, head: dict[str, Any], classes: int, rows: int) -> Any:
        """Create arrays with the shapes of the stored ones."""
        number = self.features(_NOTHING).shape[1]
        return [jax.numpy.zeros(one, np.float32) for one in ((number,), (number,), (number, classes), (classes,))]

    def from_stored(self, head: dict[str, Any], arrays: Any) -> LinearListener:
        """Restore a classifier from the header and arrays of `LinearListener.to_stored`."""
        return LinearListener(self.features, *(np.asarray(one, float) for one in arrays))


LEARNERS: dict[str, Any] = {
    "paper-network": NetworkLearner(paper_plan),
    "network": NetworkLearner(library_plan),
    "trees": TreesListener,
    "spectrum": LinearLearner(spectrum_features),
    "linear": LinearLearner(sound_features),
}
"""Learners by name, the simplest last, which is chosen among equally accurate ones; the network is trained by the
schedule of the paper, or by this library's."""


def num_features() -> int:
    """Number of hand-made features."""
    return sound_features(_NOTHING).shape[1]


_NOTHING = SoundImages(np.zeros(0), np.zeros((0, 1, 41)), np.zeros((0, 64, 41)), np.zeros(0, int), np.zeros(0, bool))


def stopping_rows(window_classes: Int[np.ndarray, " W"], groups: Int[np.ndarray, " W"]) -> np.ndarray:
    """Choose the windows (W,) that are held out for early stopping: whole groups, spread over the classes.

    No group is held out of a class that has fewer than three.
    """
    held = np.zeros(len(window_classes), bool)
    chosen: set[int] = set()
    for one in np.unique(window_classes):
        own = np.unique(groups[window_classes == one])
        wanted = len(own) // _STOPPING if len(own) >= _STOPPING else int(len(own) >= 3)
        already = chosen & set(own.tolist())
        rest = [group for group in own.tolist() if group not in chosen]
        order = np.random.default_rng(int(one)).permutation(len(rest))
        chosen |= {rest[place] for place in order[: max(0, wanted - len(already))]}
    held = np.isin(groups, sorted(chosen))
    # Every class must remain in the training set, otherwise nothing is held out.
    return (
        held
        if set(window_classes[~held].tolist()) == set(window_classes.tolist())
        else np.zeros(len(window_classes), bool)
    )
