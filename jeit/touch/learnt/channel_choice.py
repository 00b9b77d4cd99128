"""Select the few channels that are most informative about the answers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def choose_channels(
    scaled: Float[np.ndarray, "N m"], answers: Float[np.ndarray, "N q"], number: int
) -> Int[np.ndarray, " n"]:
    """Select channels by simultaneous orthogonal matching pursuit (Tropp et al. 2006), the most informative first.

    Each explains most of what the previous channels leave unexplained of the answers, by least squares. Products of the
    answers with one another are explained too, since places are not linear in voltages.
    """
    products = [answers[:, i] * answers[:, j] for i in range(answers.shape[1]) for j in range(i + 1)]
    left = np.column_stack([answers, *(one - one.mean() for one in products[:20])])
    left = left - left.mean(axis=0)
    candidates = scaled - scaled.mean(axis=0)
    first = np.sum(candidates**2, axis=0)
    chosen: list[int] = []
    for _ in range(min(number, scaled.shape[1])):
        size = np.sum(candidates**2, axis=0)
        gain = np.sum((candidates.T @ left) ** 2, axis=1) / np.where(size > 1e-8 * first, size, np.inf)
        gain[chosen] = -1
        best = int(gain.argmax())
        chosen.append(best)
        if size[best] > 1e-8 * first[best]:
            direction = candidates[:, best] / np.sqrt(size[best])
            left = left - np.outer(direction, direction @ left)
            candidates = candidates - np.outer(direction, direction @ candidates)
    return np.array(chosen)
