"""Learn to predict places or forces, with calibrated standard deviations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jeit.touch.learnt.extras import apply_over_folds
from jeit.touch.learnt.features import Features, Forms
from jeit.touch.learnt.imaged import ImageReconstruction
from jeit.touch.learnt.methods import OF_CHANNELS, QUICK, REGRESSORS

_LIKE, _SHARES = 40, ((1.0, 0.6827), (1.96, 0.95))
# Weight of the size of the changes relative to the predicted values, in the distance between presses; fraction of a
# variance that is the mean squared error of all presses, where the rest is that of similar presses.
_SIZE, _ALL = 0.3, 0.15
# Minimum number of presses from which the coverage of standard deviations is estimated.
_ENOUGH = 30
# Minimum standard deviation, relative to the spread of the predictions for the training set.
_LEAST = 1e-4


@dataclass(frozen=True)
class DeviationModel:
    """Model of the standard deviations of predictions, from the errors of similar held-out presses.

    `where` (N, d + 1): predicted values of the held-out presses and the logarithm of the size of their changes, minus
    `low` (d + 1,) and divided by `unit` (d + 1,); `squares` (N, d): squared errors of these presses; `factor` (d,):
    calibration factors of the standard deviations.
    """

    where: Float[np.ndarray, "N e"]
    squares: Float[np.ndarray, "N d"]
    low: Float[np.ndarray, " e"]
    unit: Float[np.ndarray, " e"]
    factor: Float[np.ndarray, " d"]

    @classmethod
    def learn(
        cls, predictions: np.ndarray, changes: np.ndarray, errors: np.ndarray, last: np.ndarray
    ) -> "DeviationModel":
        """Fit to predictions `predictions` (N, d) for held-out presses, their changes (N, m), and their errors (N, d).

        `last` (N,): presses recorded before or after all presses that their predictions were learnt from. If there are
        enough of them, the standard deviations are calibrated on these alone, since future presses are predicted
        likewise.
        """
        where = np.column_stack([predictions, _log_size(changes)])
        low, unit = where.mean(axis=0), where.std(axis=0)
        unit = np.where(unit > 0, unit, 1.0)
        unit[-1] /= _SIZE
        most = np.quantile(np.abs(errors), 0.99, axis=0)  # one large error is not representative of its neighbours
        squares = np.minimum(np.abs(errors), most) ** 2
        found = cls((where - low) / unit, squares, low, unit, np.ones(errors.shape[1]))
        local = found._local_deviations(found.where, leave_one_out=True)
        last = last if last.sum() >= _ENOUGH else np.ones_like(last)
        factor = [
            _calibration_factor(np.abs(error) / one) for error, one in zip(errors[last].T, local[last].T, strict=True)
        ]
        return cls(found.where, squares, low, unit, np.array(factor))

    def __call__(self, predictions: np.ndarray, changes: np.ndarray) -> Float[np.ndarray, "n d"]:
        """Compute the standard deviations (n, d) of predictions `predictions` (n, d) for frames with these changes (n,
        m)."""
        where = (np.column_stack([predictions, _log_size(changes)]) - self.low) / self.unit
        return self.factor * self._local_deviations(where)

    def held_out(self, predictions: np.ndarray, changes: np.ndarray) -> Float[np.ndarray, "N d"]:
        """Compute the standard deviations (N, d) of the held-out presses, each without its own error."""
        where = (np.column_stack([predictions, _log_size(changes)]) - self.low) / self.unit
        return self.factor * self._local_deviations(where, leave_one_out=True)

    def _local_deviations(self, where: np.ndarray, *, leave_one_out: bool = False) -> np.ndarray:
        number = min(_LIKE, len(self.where) - 1)
        near = np.asarray(self._search_tree.query(where, number + leave_one_out)[1])[:, int(leave_one_out) :]
        like = self.squares[near].mean(axis=1)
        everywhere = self.squares.mean(axis=0)
        return np.maximum(np.sqrt((1 - _ALL) * like + _ALL * everywhere), _LEAST * self.unit[: like.shape[1]])

    @cached_property
    def _search_tree(self) -> KDTree:
        return KDTree(self.where)


def _log_size(changes: np.ndarray) -> np.ndarray:
    return np.log(np.sqrt(np.mean(changes**2, axis=1)) + 1e-300)


def _calibration_factor(ratios: np.ndarray) -> float:
    """Compute the calibration factor of standard deviations from the ratios of errors to standard deviations.

    With this factor, the shares of errors within 1 and 1.96 standard deviations are nearest to those of a normal
    distribution.
    """
    candidates = np.geomspace(0.2, 5, 200)
    missed = [
        max(abs(np.mean(ratios <= times * candidate) - share) for times, share in _SHARES) for candidate in candidates
    ]
    return float(candidates[int(np.argmin(missed))])


BLEND = "blend"
METHODS = ("auto", *REGRESSORS, BLEND)
# Maximum number of methods in a blend; maximum error of a blend, relative to that of the best single method.
_BLENDED, _BETTER = 3, 0.98


@dataclass(frozen=True)
class MethodResult:
    """Result of a `method` on a `form` of the features.

    `held_out` (N, d): predictions for held-out presses; `error`: their mean error.
    """

    method: str
    form: str
    held_out: Float[np.ndarray, "N d"]
    error: float

    @property
    def name(self) -> str:
        """Name of the method and the form; for a blend, the names of its members."""
        return f"{self.method}: {self.form}" if self.method == BLEND else f"{self.method} on {self.form}"


@dataclass(frozen=True)
class LearntNumbers:
    """The average of several regressors, with standard deviations of its predictions.

    `members`: pairs of features and a regressor of standardised targets; a prediction is `mean` + `scale` × the average
    of the members. `spread`: model of the standard deviations.
    """

    members: list[tuple[Features, Any]]
    mean: Float[np.ndarray, " d"]
    scale: float
    spread: DeviationModel

    def predict(
        self, changes: Float[np.ndarray, "n m"], reference: Float[np.ndarray, "n m"]
    ) -> Float[np.ndarray, "n d"]:
        """Predict targets (n, d) from changes (n, m) and their reference."""
        said = 0.0
        for features, model in self.members:
            said = said + np.asarray(model.predict(features(changes, reference))).reshape(len(changes), -1)
        return self.mean + self.scale * said / len(self.members)


def learn_numbers(
    changes: Float[np.ndarray, "N m"],
    reference: Float[np.ndarray, "N m"] | None,
    targets: Float[np.ndarray, "N d"],
    folds: np.ndarray,
    *,
    method: str = "auto",
    imaged: ImageReconstruction | None = None,
    progress: Callable[[str], None] = lambda said: None,
) -> tuple[LearntNumbers, list[MethodResult]]:
    """Learn `targets` (N, d) from changes (N, m), their reference, and images of the changes if `imaged` is given.

    `method`: one of `METHODS`; "auto" chooses the best method, or a blend if it is better. Also returns the results of
    all methods that were tried, in order of their mean errors in cross-validation on `folds` (N,). Quick methods are
    tried on all forms of the features, the others on the one or two forms with the lowest error of a quick method.
    """
    has_reference = reference is not None
    reference = np.zeros_like(changes) if reference is None else reference
    forms = Forms.available(targets, imaged, has_reference=has_reference)
    cut = _CrossValidation(changes, reference, targets, folds, forms)
    tried = []
    for form in forms.names:
        for quick in QUICK:
            progress(f"{quick} on {form}")
            tried.append(cut.hold_out(quick, form))
    best = list(dict.fromkeys(one.form for one in sorted(tried, key=_mean_error)))[:2]
    wanted = [one for one in REGRESSORS if one not in QUICK and method in ("auto", BLEND, one)]
    for name in wanted:
        for form in best if name in ("gaussian-process", "forest") else best[:1]:
            progress(f"{name} on {form}")
            tried.append(cut.hold_out(name, form))
    tried.sort(key=_mean_error)
    if method not in ("auto", BLEND):
        tried = [one for one in tried if one.method == method]
    chosen = _choose_methods(tried, targets, blend=method == BLEND) if method in ("auto", BLEND) else tried[:1]
    said = np.mean([one.held_out for one in chosen], axis=0)
    if len(chosen) > 1:
        tried.insert(
            0, MethodResult(BLEND, " + ".join(one.name for one in chosen), said, _mean_distance(said, targets))
        )
    members = []
    for one in chosen:
        progress(f"{one.method}, all presses")
        features = forms.learn(one.form, changes, reference, targets, rotated=one.method not in OF_CHANNELS)
        model = REGRESSORS[one.method](features(changes, reference), (targets - cut.mean) / cut.scale)
        members.append((features, model))
    ends = (folds == 0) | (folds == folds.max())
    spread = DeviationModel.learn(said, changes, said - targets, ends)
    return LearntNumbers(members, cut.mean, cut.scale, spread), tried


def _choose_methods(tried: list[MethodResult], targets: np.ndarray, *, blend: bool) -> list[MethodResult]:
    """Choose the best method alone, or a blend of several methods if it is better or `blend` requires it."""
    own = list({one.method: one for one in reversed(tried)}.values())
    own = sorted(own, key=_mean_error)[:_BLENDED]
    together = [own[:number] for number in range(2, len(own) + 1)]
    best = min(together, key=lambda some: _mean_distance(np.mean([one.held_out for one in some], axis=0), targets))
    error = _mean_distance(np.mean([one.held_out for one in best], axis=0), targets)
    return best if blend or error < _BETTER * own[0].error else own[:1]


def _mean_error(result: MethodResult) -> float:
    return result.error


def _mean_distance(predictions: np.ndarray, targets: np.ndarray) -> float:
    """Compute the mean distance of predictions from targets."""
    return float(np.linalg.norm(predictions - targets, axis=1).mean())


class _CrossValidation:
    """Cross-validation of methods, in which the features of each form and fold are computed once for all methods."""

    def __init__(self, changes, reference, targets, folds, forms: Forms):
        self.changes, self.reference, self.targets, self.folds = changes, reference, targets, folds
        self.forms = forms
        self.mean = targets.mean(axis=0)
        self.scale = float(np.sqrt(np.mean((targets - self.mean) ** 2)))
        self.features = {}

    def hold_out(self, method: str, form: str) -> MethodResult:
        said = np.empty_like(self.targets)

        def predict(fold: int) -> None:
            out = self.folds == fold
            learnt, asked = self._fold_features(form, fold, out, rotated=method not in OF_CHANNELS)
            model = REGRESSORS[method](learnt, (self.targets[~out] - self.mean) / self.scale)
            said[out] = self.mean + self.scale * np.asarray(model.predict(asked)).reshape(int(out.sum()), -1)

        apply_over_folds(predict, self.folds.max() + 1)
        return MethodResult(method, form, said, _mean_distance(said, self.targets))

    def _fold_features(self, form: str, fold: int, out: np.ndarray, *, rotated: bool) -> tuple[np.ndarray, np.ndarray]:
        if (form, fold, rotated) not in self.features:
            learnt = self.changes[~out], self.reference[~out], self.targets[~out]
            features = self.forms.learn(form, *learnt, rotated=rotated)
            self.features[form, fold, rotated] = tuple(
                features(self.changes[some], self.reference[some]) for some in (~out, out)
            )
        return self.features[form, fold, rotated]
