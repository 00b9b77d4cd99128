"""What a method learns from: changes of the channels in one of several forms, as scores of principal components."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Components at most, and presses for each.
_MOST, _PRESSES_EACH = 60, 3


def _differences(changes, reference, unit):
    return changes / unit


def _ratios(changes, reference, unit):
    size = np.maximum(np.abs(reference), 1e-3 * np.sqrt(np.mean(reference**2, axis=1, keepdims=True)))
    return changes / np.where(size > 0, size, 1.0)


def _compressed(changes, reference, unit):
    return np.sign(changes) * np.log1p(np.abs(changes) / unit)


def _normalised(changes, reference, unit):
    size = np.sqrt(np.mean((changes / unit) ** 2, axis=1, keepdims=True))
    size = np.where(size > 0, size, 1.0)
    return np.hstack([changes / unit / size, np.log(size)])


def _shapes(changes, reference, unit):
    size = np.sqrt(np.mean(changes**2, axis=1, keepdims=True))
    size = np.where(size > 0, size, 1.0)
    return np.hstack([changes / size, np.log(size)])


# Changes (n, m), the reference (n, m), and a unit (m,) for each channel, to features.
FORMS = {
    "differences": _differences,
    "ratios": _ratios,
    "compressed": _compressed,
    "normalised": _normalised,
    "shapes": _shapes,
}


@dataclass(frozen=True)
class Features:
    """Features of one `form`: standardised by `mean` and `deviation` (p,), then scores of any `components` (p, k)."""

    form: str
    unit: Float[np.ndarray, " m"]
    mean: Float[np.ndarray, " p"]
    deviation: Float[np.ndarray, " p"]
    components: Float[np.ndarray, "p k"] | None

    @classmethod
    def learn(cls, form: str, changes: np.ndarray, reference: np.ndarray, *, rotated: bool = True) -> "Features":
        """From changes (N, m) and their reference (N, m); without components unless `rotated`."""
        unit, values, mean, deviation = standardisation(form, changes, reference)
        if not rotated:
            return cls(form, unit, mean, deviation, None)
        rows = np.linalg.svd((values - mean) / deviation, full_matrices=False)[2]
        return cls(form, unit, mean, deviation, rows[: max(2, min(_MOST, len(values) // _PRESSES_EACH))].T)

    def __call__(self, changes: np.ndarray, reference: np.ndarray) -> Float[np.ndarray, "n k"]:
        """Scores (n, k) of changes (n, m)."""
        values = FORMS[self.form](changes, reference, self.unit)
        standard = (values - self.mean) / self.deviation
        return standard if self.components is None else standard @ self.components


def standardisation(form: str, changes: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of changes (N, m): each channel's unit, its usual size; features (N, p) of the `form`, their mean and deviation,
    infinite where one never changes."""
    size = np.abs(changes)
    unit = np.median(size, axis=0)
    unit = np.where(unit > 0, unit, np.mean(size, axis=0))
    values = FORMS[form](changes, reference, np.where(unit > 0, unit, 1.0))
    deviation = values.std(axis=0)
    known = deviation > 1e-9 * max(deviation.max(), 1e-300)
    return np.where(unit > 0, unit, 1.0), values, values.mean(axis=0), np.where(known, deviation, np.inf)


def forms_for(has_reference: bool) -> tuple[str, ...]:
    """Those that can be made."""
    return tuple(form for form in FORMS if has_reference or form != "ratios")
