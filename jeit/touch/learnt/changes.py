"""Compute changes from frames, by subtracting the untouched skin's reference, and standardise them by session."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# The least number of frames of a session that can be standardised by itself.
_SESSION = 20


def changes_of(frames: Float[np.ndarray, "n M"], reference: np.ndarray | None) -> Float[np.ndarray, "n M"]:
    """Subtract the reference from frames, if there is one."""
    return frames if reference is None else frames - reference


def standardised(changes: np.ndarray, group) -> np.ndarray:
    """Standardise changes (n, M): subtract their session's median, and divide by their session's deviation.

    All are one session unless `group` (n,) is given. Raises `ValueError` for sessions of fewer than 20 frames.
    """
    group = np.zeros(len(changes), int) if group is None else np.asarray(group)
    if group.shape != (len(changes),):
        raise ValueError(f"group has shape {group.shape}; give ({len(changes)},), the session of each frame.")
    result = np.empty_like(changes)
    for session in np.unique(group):
        own = changes[group == session]
        if len(own) < _SESSION:
            raise ValueError(
                f"group: session {session} has {len(own)} frames; {_SESSION} are needed to standardise one."
            )
        deviation = np.nanstd(own, axis=0)
        result[group == session] = (own - np.nanmedian(own, axis=0)) / np.where(deviation > 0, deviation, np.inf)
    return result


def mean_reference(reference: np.ndarray) -> np.ndarray:
    """Mean reference of every channel; 0 where it has no reading at all."""
    there = np.isfinite(reference)
    return np.where(there, reference, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)


def reference_used(
    reference: np.ndarray | None, mean: np.ndarray | None, used: Bool[np.ndarray, " M"], number: int
) -> Float[np.ndarray, "n m"]:
    """Reference (n, M) of the channels `used`; zeros if there is none.

    Where it has no reading, the `mean` (M,) of the training set is used.
    """
    if reference is None or mean is None:
        return np.zeros((number, int(used.sum())))
    return np.where(np.isnan(reference), mean, reference)[:, used]
