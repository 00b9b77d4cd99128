"""Detection of changes of the microphones since the calibration, from the misfit of located touches: exchanged
microphones, or a microphone whose response has changed."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jeit.acoustic.localisation.localiser import Localiser
from jeit.acoustic.microphones import MicrophoneArray

# Number of the loudest frames that are used; misfit per degree of freedom above which changes of the setup are searched
# for; value at which the misfit per degree of freedom is clipped; maximum ratio of the misfits after and before an
# accepted change.
_NUM_FRAMES, _LARGE_MISFIT, _MAX_MISFIT, _MAX_MISFIT_RATIO = 24, 3.0, 100.0, 0.7
# Maximum number of changes of the setup that are searched for.
_MAX_CHANGES = 4
# A single microphone is left out for a test only if more than this number of microphones are not yet changed.
_MIN_REMAINING = 5


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
    """Find changes of the setup that explain the misfit of touches: with the microphones exchanged back, or left out,
    one source explains the frames.

    `power` (F, M): intensities minus the noise floor of frames with a touch; `use` (F, M): mask of the usable
    intensities. Only the loudest frames are used. The search is greedy: it repeatedly accepts the change that lowers
    the misfit most, so it finds several changes only if each change alone lowers the misfit. No changes are returned
    for fewer than three frames, if one source explains the frames without a change, or if no change explains the
    misfit.
    """
    loudest_frames = np.argsort(-np.where(use, power, 0.0).sum(axis=1))[:_NUM_FRAMES]
    changes = SetupChanges([], [])
    if len(loudest_frames) < 3:
        return changes
    loudest_frames = loudest_frames[np.arange(_NUM_FRAMES) % len(loudest_frames)]
    power, use = np.where(use, power, 0.0)[loudest_frames], use[loudest_frames]
    localiser = Localiser.create(microphone_array)

    def mean_misfit(states: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Mean misfit per degree of freedom for each candidate change, given by the order and the mask of the
        channels."""
        estimates = localiser(
            np.concatenate([power[:, order] for order, _ in states]),
            np.concatenate([use[:, order] & mask for order, mask in states]),
        )
        ratio = np.asarray(estimates.misfit) / np.maximum(np.asarray(estimates.freedom), 1)
        return np.minimum(np.nan_to_num(ratio, nan=_MAX_MISFIT), _MAX_MISFIT).reshape(len(states), -1).mean(axis=1)

    state = np.arange(power.shape[1]), np.ones(power.shape[1], bool)
    current_misfit = float(mean_misfit([state])[0])
    remaining = np.flatnonzero(use.any(axis=0))
    while (
        current_misfit > _LARGE_MISFIT
        and len(changes.exchanged) + len(changes.altered) < _MAX_CHANGES
        and remaining.size
    ):
        # Altered microphones come first among the candidate changes, since exchanging an altered microphone may lower
        # the misfit too.
        singles = [(int(k),) for k in remaining if remaining.size > _MIN_REMAINING]
        candidates = singles + [(int(k), int(m)) for k, m in combinations(remaining, 2)]
        candidate_states = [_apply_change(state, channels) for channels in candidates]
        misfits = mean_misfit(candidate_states)
        best_index = int(misfits.argmin())
        if not misfits[best_index] < _MAX_MISFIT_RATIO * current_misfit:
            break
        current_misfit, state = float(misfits[best_index]), candidate_states[best_index]
        channels = candidates[best_index]
        if len(channels) == 2:
            changes.exchanged.append((channels[0], channels[1]))
        else:
            changes.altered.append(channels[0])
        remaining = remaining[~np.isin(remaining, channels)]
    return changes if current_misfit <= _LARGE_MISFIT else SetupChanges([], [])


def _apply_change(state: tuple[np.ndarray, np.ndarray], channels: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the order and the mask of the microphones' channels after exchanging two channels, or leaving out one
    channel."""
    order, mask = (array.copy() for array in state)
    if len(channels) == 2:
        order[list(channels)] = order[list(channels[::-1])]
    else:
        mask[channels[0]] = False
    return order, mask
