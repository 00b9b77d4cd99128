"""Detection of changes since the calibration from the misfit: exchanged microphones, or a microphone with another
gain."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.microphones import MicrophoneArray

# Number of loudest frames used; misfit per degree of freedom above which a change is searched for, and at which it is
# clipped; fraction to which a change must lower the misfit to be accepted.
_FRAMES, _WRONG, _MOST, _BETTER = 24, 3.0, 100.0, 0.7
_MOST_CHANGES = 4
# Least number of remaining microphones for a test without one microphone to be meaningful.
_LEAST_LEFT = 5


class SetupChanges(NamedTuple):
    """`exchanged`: pairs of exchanged microphones; `altered`: microphones whose response has changed."""

    exchanged: list[tuple[int, int]]
    altered: list[int]


def find_setup_changes(
    microphone_array: MicrophoneArray, power: Float[np.ndarray, "F M"], use: Bool[np.ndarray, "F M"]
) -> SetupChanges:
    """Find the microphones, or pairs of exchanged microphones, after whose removal or re-exchange one source explains
    the frames; empty where no such change does.

    `power` (F, M): intensities above the floor of frames with a touch. Uses the loudest frames; returns nothing for
    fewer than three frames, or where the typical frame is explained already. The search is greedy, the best change
    first: of several changes, only those are found each of which lowers the misfit alone.
    """
    loudest = np.argsort(-np.where(use, power, 0.0).sum(axis=1))[:_FRAMES]
    changes = SetupChanges([], [])
    if len(loudest) < 3:
        return changes
    loudest = loudest[np.arange(_FRAMES) % len(loudest)]
    power, use = np.where(use, power, 0.0)[loudest], use[loudest]
    localiser = Localiser.create(microphone_array)

    def misfit(tried: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Mean misfit per degree of freedom for each of several pairs of channel order and mask."""
        found = localiser(
            np.concatenate([power[:, order] for order, _ in tried]),
            np.concatenate([use[:, order] & kept for order, kept in tried]),
        )
        ratio = np.asarray(found.misfit) / np.maximum(np.asarray(found.freedom), 1)
        return np.minimum(np.nan_to_num(ratio, nan=_MOST), _MOST).reshape(len(tried), -1).mean(axis=1)

    state = np.arange(power.shape[1]), np.ones(power.shape[1], bool)
    now = float(misfit([state])[0])
    left = np.flatnonzero(use.any(axis=0))
    while now > _WRONG and len(changes.exchanged) + len(changes.altered) < _MOST_CHANGES and left.size:
        # An altered microphone is tested before exchanges with it, which may lower the misfit a little too.
        singles = [(int(k),) for k in left if left.size > _LEAST_LEFT]
        candidates = singles + [(int(k), int(m)) for k, m in combinations(left, 2)]
        tried = [_changed(state, which) for which in candidates]
        values = misfit(tried)
        best = int(values.argmin())
        if not values[best] < _BETTER * now:
            break
        now, state = float(values[best]), tried[best]
        which = candidates[best]
        if len(which) == 2:
            changes.exchanged.append((which[0], which[1]))
        else:
            changes.altered.append(which[0])
        left = left[~np.isin(left, which)]
    return changes if now <= _WRONG else SetupChanges([], [])


def _changed(state: tuple[np.ndarray, np.ndarray], which: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Order and mask of the channels with a pair exchanged or one channel left out."""
    order, kept = (part.copy() for part in state)
    if len(which) == 2:
        order[list(which)] = order[list(which[::-1])]
    else:
        kept[which[0]] = False
    return order, kept
