"""The predictions of a learnt skin for frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class Touches:
    """Predictions for n frames; what was not learnt is None.

    **Fields**

    - `position` (n, 2 or 3) metres with standard deviations `position_std`; `force` (n,) N with `force_std`; `label`
      (n,) text with `probability`; `touched` (n, K), which keys are pressed, with `key_probability`. NaN, "" and false
      where nothing touches, and in frames that are unlike the training set.
    - `unlike` (n,): frames unlike the training set, by their `novelty` (n,), 1 for the farthest frame in it.
    - `alive` (n, M): channels that were used.
    - `notes`: what was corrected.
    """

    position: Float[np.ndarray, "n d"] | None
    position_std: Float[np.ndarray, "n d"] | None
    force: Float[np.ndarray, " n"] | None
    force_std: Float[np.ndarray, " n"] | None
    label: np.ndarray | None
    probability: Float[np.ndarray, " n"] | None
    touched: Bool[np.ndarray, "n K"] | None
    key_probability: Float[np.ndarray, "n K"] | None
    unlike: Bool[np.ndarray, " n"]
    novelty: Float[np.ndarray, " n"]
    alive: Bool[np.ndarray, "n M"]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.unlike)
