"""Learn labels of frames, by the classifier most accurate on held-out presses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jeit.touch.learnt.classifiers import CLASSIFIERS, log_odds, probabilities, sharpness_of, shrinkage_of
from jeit.touch.learnt.extras import over_folds
from jeit.touch.learnt.features import Features, Forms
from jeit.touch.learnt.imaged import Imaged

METHODS = ("auto", *CLASSIFIERS)
_QUICK = "linear-discriminant"


@dataclass(frozen=True)
class TriedLabels:
    """A `method` on a `form` of the features, and its results on held-out presses.

    They are the predicted labels (N,), the log-odds (N, C), and the share of errors.
    """

    method: str
    form: str
    held_out: np.ndarray
    odds: Float[np.ndarray, "N C"]
    error: float


@dataclass(frozen=True)
class LearntLabels:
    """A classifier of features, its `classes` (C,), and the sharpness of its probabilities; `notes` on it."""

    features: Features
    model: Any
    classes: np.ndarray
    sharpness: float
    notes: list[str]

    def predict(self, changes, reference) -> tuple[np.ndarray, Float[np.ndarray, " n"]]:
        """Predict labels (n,) and the probability of each (n,)."""
        odds = log_odds(self.model, self.features(changes, reference))
        return self.classes[odds.argmax(axis=1)], probabilities(odds, self.sharpness).max(axis=1)


def learn_labels(
    changes: Float[np.ndarray, "N m"],
    reference: Float[np.ndarray, "N m"] | None,
    label: np.ndarray,
    folds: np.ndarray,
    *,
    method: str = "auto",
    imaged: Imaged | None = None,
    progress: Callable[[str], None] = lambda said: None,
) -> tuple[LearntLabels, list[TriedLabels]]:
    """Learn `label` (N,) from changes (N, m), their reference, and images of them where there are any.

    By `method`, or by the one of the nine with the least error. Also returns the predictions of every method that was
    tried, in order of their errors on `folds` (N,). The form of the features is the one that suits the linear
    discriminant best.
    """
    has_reference = reference is not None
    reference = np.zeros_like(changes) if reference is None else reference
    classes, right = np.unique(label, return_inverse=True)
    forms = Forms.of(right[:, None], imaged, has_reference=has_reference)
    tried = []
    for form in forms.names:
        progress(f"{_QUICK} on {form}")
        tried.append(_hold_out(_QUICK, form, forms, changes, reference, right, folds))
    form = min(tried, key=_error).form
    for name in [one for one in CLASSIFIERS if one != _QUICK and method in ("auto", one)]:
        progress(f"{name} on {form}")
        tried.append(_hold_out(name, form, forms, changes, reference, right, folds))
    tried.sort(key=_error)
    tried = [one for one in tried if method in ("auto", one.method)]
    best = tried[0]
    features = forms.learn(best.form, changes, reference, right[:, None])
    scores = features(changes, reference)
    notes = []
    if best.method == "quadratic-discriminant" and shrinkage_of(scores, right):
        fewest = np.bincount(right).min()
        notes.append(
            f"quadratic discriminant: a class has only {fewest} presses for {scores.shape[1]} features; covariances "
            f"are shrunk by {shrinkage_of(scores, right):g}."
        )
    model = CLASSIFIERS[best.method](scores, right)
    return LearntLabels(features, model, classes, sharpness_of(best.odds, right), notes), tried


def _error(one: TriedLabels) -> float:
    return one.error


def _hold_out(method, form, forms: Forms, changes, reference, right, folds) -> TriedLabels:
    number = right.max() + 1
    odds = np.full((len(right), number), -1e3)

    def predict(fold: int) -> None:
        out = folds == fold
        features = forms.learn(form, changes[~out], reference[~out], right[~out, None])
        model = CLASSIFIERS[method](features(changes[~out], reference[~out]), right[~out])
        odds[np.ix_(out, model.classes_)] = log_odds(model, features(changes[out], reference[out]))

    over_folds(predict, folds.max() + 1)
    held_out = odds.argmax(axis=1)
    return TriedLabels(method, form, held_out, odds, float(np.mean(held_out != right)))
