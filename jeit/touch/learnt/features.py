"""Features of frames: several forms of the changes, standardised, and their principal components."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.touch.learnt.imaged import ContactFeatures, ImageFeatures, ImageReconstruction

# Minimum number of frames with the same targets as another frame, from which the noise of frames is estimated.
_MIN_REPEATED_FRAMES = 20


@dataclass(frozen=True)
class WhitenedChanges:
    """Features: changes times `root` (m, m). The variation between repeated frames then has unit covariance."""

    root: Float[np.ndarray, "m m"]

    @classmethod
    def learn(cls, changes: Float[np.ndarray, "N m"], answers: Float[np.ndarray, "N d"]) -> "WhitenedChanges":
        """Fit the whitening to frames, of which some have the same `answers`.

        The covariance of the variation between frames with the same answers is shrunk as in Ledoit and Wolf (2004).
        """
        from sklearn.covariance import ledoit_wolf

        scale = np.maximum(changes.std(axis=0), 1e-300)
        group, count = _group_equal_rows(answers)
        means = np.zeros((len(count), changes.shape[1]))
        np.add.at(means, group, changes / count[group, None])
        residuals = ((changes - means[group]) / scale)[count[group] > 1]
        if not residuals.any():
            return cls(np.diag(1 / scale))
        degrees_of_freedom = len(residuals) - np.sum(count > 1)
        values, vectors = np.linalg.eigh(
            len(residuals) / degrees_of_freedom * ledoit_wolf(residuals, assume_centered=True)[0]
        )
        values = np.maximum(values, 1e-12 * values.max())
        return cls((vectors / np.sqrt(values)) @ vectors.T / scale[:, None])

    def __call__(self, changes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Compute the features (n, m) of changes (n, m)."""
        return changes @ self.root

    def deviation(self, values: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
        """Return the unit of the features, the same for all: the root mean square of their standard deviations."""
        return np.full(values.shape[1], np.sqrt(np.mean(values.var(axis=0))))


def are_repeated(answers: Float[np.ndarray, "N d"]) -> bool:
    """Whether enough frames have the same answers as another frame to estimate their noise."""
    return int(np.sum(_group_equal_rows(answers)[1] - 1)) >= _MIN_REPEATED_FRAMES


def _group_equal_rows(targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the frames (N,) such that frames with equal `targets` have the same number; also return the number of
    frames with each number."""
    group, count = np.unique(targets, axis=0, return_inverse=True, return_counts=True)[1:]
    return group.ravel(), count


# Maximum number of principal components; number of presses required for each.
_MAX_COMPONENTS, _PRESSES_PER_COMPONENT = 60, 3


def _divide_by_unit(changes, reference, unit):
    """Compute features (n, m): changes divided by the `unit` of each channel."""
    return changes / unit


def _divide_by_reference(changes, reference, unit):
    """Compute features (n, m): changes relative to the reference."""
    size = np.maximum(np.abs(reference), 1e-3 * np.sqrt(np.mean(reference**2, axis=1, keepdims=True)))
    return changes / np.where(size > 0, size, 1.0)


def _compress_changes(changes, reference, unit):
    """Compute features (n, m): changes, divided by `unit`, on a scale that compresses large ones."""
    return np.sign(changes) * np.log1p(np.abs(changes) / unit)


def _normalise_scaled_changes(changes, reference, unit):
    """Compute features (n, m + 1): changes divided by `unit` and by the frame's root mean square, and its logarithm."""
    size = np.sqrt(np.mean((changes / unit) ** 2, axis=1, keepdims=True))
    size = np.where(size > 0, size, 1.0)
    return np.hstack([changes / unit / size, np.log(size)])


def _normalise_changes(changes, reference, unit):
    """Compute features (n, m + 1): changes divided by the frame's root mean square, and its logarithm, without
    `unit`."""
    size = np.sqrt(np.mean(changes**2, axis=1, keepdims=True))
    size = np.where(size > 0, size, 1.0)
    return np.hstack([changes / size, np.log(size)])


# Forms of features: functions of changes (n, m), the reference (n, m), and a unit (m,) for each channel.
FORMS = {
    "differences": _divide_by_unit,
    "ratios": _divide_by_reference,
    "compressed": _compress_changes,
    "normalised": _normalise_scaled_changes,
    "shapes": _normalise_changes,
}
# Functions that fit a learnt form of features to changes (N, m) and targets (N, d).
Maker = Callable[[np.ndarray, np.ndarray], WhitenedChanges | ContactFeatures | ImageFeatures]


@dataclass(frozen=True)
class Features:
    """Features of one `form`, standardised, and optionally reduced to principal components.

    `mean` and `deviation` (p,) standardise the features; `components` (p, k): the principal components, or None.
    `made`: computes the features if the form is learnt, None otherwise; `unit` (m,): unit of each channel for the other
    forms.
    """

    form: str
    unit: Float[np.ndarray, " m"]
    mean: Float[np.ndarray, " p"]
    deviation: Float[np.ndarray, " p"]
    components: Float[np.ndarray, "p k"] | None
    made: WhitenedChanges | ContactFeatures | ImageFeatures | None = None

    @classmethod
    def learn(
        cls,
        form: str,
        changes: Float[np.ndarray, "N m"],
        reference: Float[np.ndarray, "N m"],
        *,
        made: WhitenedChanges | ContactFeatures | ImageFeatures | None = None,
        rotated: bool = True,
    ) -> "Features":
        """Fit the features to changes of voltage and their reference.

        If `rotated`, features are reduced to principal components, except the few features of a contact.
        """
        if made is None:
            unit, values, mean, deviation = standardisation(form, changes, reference)
        else:
            unit, values = np.ones(changes.shape[1]), made(changes)
            mean, deviation = values.mean(axis=0), _replace_zeros_by_infinity(made.deviation(values))
        if not rotated or isinstance(made, ContactFeatures):
            return cls(form, unit, mean, deviation, None, made)
        rows = np.linalg.svd((values - mean) / deviation, full_matrices=False)[2]
        components = rows[: max(2, min(_MAX_COMPONENTS, len(values) // _PRESSES_PER_COMPONENT))].T
        return cls(form, unit, mean, deviation, components, made)

    def __call__(self, changes: np.ndarray, reference: np.ndarray) -> Float[np.ndarray, "n k"]:
        """Compute the features (n, k) of changes (n, m)."""
        values = FORMS[self.form](changes, reference, self.unit) if self.made is None else self.made(changes)
        standardised_values = (values - self.mean) / self.deviation
        return standardised_values if self.components is None else standardised_values @ self.components


def standardisation(form: str, changes: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, ...]:
    """Compute the standardisation of features of a `form` from changes (N, m).

    Returns the unit of each channel (m,), its usual absolute change; the features (N, p); and their mean and standard
    deviation (p,), which is infinite for a feature that never changes.
    """
    size = np.abs(changes)
    unit = np.median(size, axis=0)
    unit = np.where(unit > 0, unit, np.mean(size, axis=0))
    values = FORMS[form](changes, reference, np.where(unit > 0, unit, 1.0))
    return np.where(unit > 0, unit, 1.0), values, values.mean(axis=0), _replace_zeros_by_infinity(values.std(axis=0))


def _replace_zeros_by_infinity(deviation: np.ndarray) -> np.ndarray:
    """Replace standard deviations that are negligible compared with the largest one by infinity."""
    is_nonzero = deviation > 1e-9 * max(deviation.max(), 1e-300)
    return np.where(is_nonzero, deviation, np.inf)


@dataclass(frozen=True)
class Forms:
    """The forms of features that are available.

    `names`: names of all forms; `makers`: functions that fit the learnt forms, which need repeated frames or images.
    """

    names: tuple[str, ...]
    makers: dict[str, Maker]

    @classmethod
    def available(
        cls, answers: Float[np.ndarray, "N d"], imaged: ImageReconstruction | None, *, has_reference: bool
    ) -> "Forms":
        """Return the forms that can be computed from the data."""
        makers: dict[str, Maker] = {"whitened": WhitenedChanges.learn} if are_repeated(answers) else {}
        if imaged is not None:
            makers |= {"contacts": lambda changes, answers: ContactFeatures(imaged)}
            makers |= {"images": lambda changes, answers: ImageFeatures(imaged)}
        unlearnt_forms = [form for form in FORMS if has_reference or form != "ratios"]
        return cls((*unlearnt_forms, *makers), makers)

    def learn(self, form: str, changes, reference, answers, *, rotated: bool = True) -> Features:
        """Fit features of one form, as `Features.learn` does."""
        made = self.makers[form](changes, answers) if form in self.makers else None
        return Features.learn(form, changes, reference, made=made, rotated=rotated)
