"""Detection of changes since the calibration from the misfit: exchanged microphones, or a microphone whose response has
changed."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.microphones import MicrophoneArray

# Number of the loudest frames that are used; misfit per degree of freedom above which changes are searched for; value
# at which the misfit per degree of freedom is clipped; maximum ratio of the misfits after and before an accepted
# change.
_FRAMES, _WRONG, _MOST, _BETTER = 24, 3.0, 100.0, 0.7
# Maximum number of changes that are searched for.
_MOST_CHANGES = 4
# A single microphone is left out for a test only if more than this number of microphones remain.
_LEAST_LEFT = 5


class SetupChanges(NamedTuple):
    """Changes of the setup since the calibration.

    **Fields**: `exchanged`: pairs of indices of exchanged microphones; `altered`: indices of microphones whose response
    has changed.
    """

    exchanged: list[tuple[int, int]]
    altered: list[int]


def find_setup_changes(
    microphone_array: MicrophoneArray, power: Float[np.ndarray, "F M"], use: Bool[np.ndarray, "F M"]
) -> SetupChanges:
    """Find changes of the setup that explain the misfit: with the microphones exchanged back, or left out, one source
    explains the frames.

    `power` (F, M): intensities minus the floor of frames with a touch; `use` (F, M): mask of the usable intensities.
    Only the loudest frames are used. The search is greedy: it repeatedly accepts the change that lowers the misfit
    most, so it finds several changes only if each of them alone lowers the misfit. No changes are returned for fewer
    than three frames, if one source explains the frames without a change, or if no change explains them.
    """
    loudest = np.argsort(-np.where(use, power, 0.0).sum(axis=1))[:_FRAMES]
    changes = SetupChanges([], [])
    if len(loudest) < 3:
        return changes
    loudest = loudest[np.arange(_FRAMES) % len(loudest)]
    power, use = np.where(use, power, 0.0)[loudest], use[loudest]
    localiser = Localiser.create(microphone_array)

    def misfit(tried: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Mean misfit per degree of freedom for each candidate, given by the order and the mask of the channels."""
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
        # Altered microphones come first among the candidates, since exchanging an altered microphone may lower the
        # misfit too.
        singles = [(int(k),) for k in left if left.size > _LEAST_LEFT]
        candidates = singles + [(int(k), int(m)) for k, m in combinations(left, 2)]
        tried = [_apply_change(state, which) for which in candidates]
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


def _apply_change(state: tuple[np.ndarray, np.ndarray], channels: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the order and the mask of the channels after exchanging two channels, or leaving out one."""
    order, kept = (part.copy() for part in state)
    if len(channels) == 2:
        order[list(channels)] = order[list(channels[::-1])]
    else:
        kept[channels[0]] = False
    return order, kept
