"""Steadiness of the channels of a skin: detect single channels that are noisy, jump, or are stuck.

Frames are averaged to steps in time. Two measures of variation are computed for every channel in a window of steps. The
mean of the smaller half of the magnitudes of its changes from step to step is hardly affected by touches; the mean of
all magnitudes responds to jumps. Both measures, in two consecutive windows, are compared with the measures of healthy
windows and of the other channels. If many channels exceed the limits of their measures at once, the cause is a touch,
not faulty channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

# Fraction of a window's changes, those of smallest magnitude, from which noise is estimated.
_SMALLEST_CHANGES_FRACTION = 0.5
# Minimum fraction of changes that have readings.
_MIN_READ_FRACTION = 0.5
# Minimum limit of a variation measure, as a multiple of the usual value.
_MIN_LIMIT_RATIO = 3.0
# Limit of a variation measure, as a multiple of the maximum among healthy windows.
_UNSTEADY_LIMIT_FACTOR = 2.0
# Increase of `_UNSTEADY_LIMIT_FACTOR`, to be divided by the number of windows.
_UNSTEADY_LIMIT_FACTOR_INCREASE = 12.0
# Minimum fraction of steps in which a healthy channel changes; a channel that changes less often never counts as stuck.
_MIN_MOVING_FRACTION = 0.6
# Maximum fraction of channels that may be noisy or stuck at once.
_MAX_UNSTEADY_FRACTION = 0.1


@dataclass(frozen=True)
class Steadiness:
    """Usual variation of healthy channels from one averaged frame to the next, and limits of the variation.

    **Fields**: `usual_values` (2, channels): usual values of two measures of variation, the mean of the smaller half of
    the magnitudes of changes and the mean of all magnitudes, volts; `limits` (2,): limits of the two measures, as
    multiples of the usual values; `can_be_stuck`: whether a channel that does not change at all counts as stuck.
    """

    usual_values: Float[np.ndarray, "2 M"]
    limits: Float[np.ndarray, " 2"]
    can_be_stuck: Bool[np.ndarray, " M"]

    @classmethod
    def learn(cls, steps: Float[np.ndarray, "n M"], window: int, noise: Float[np.ndarray, " M"]) -> "Steadiness":
        """Learn the usual variation from averaged healthy frames (`steps`), with the length of a window in steps.

        `noise`: noise of each channel, volts; infinite for channels without readings.
        """
        starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
        measures = np.array([_variation_measures(steps[start : start + window]) for start in starts])  # (windows, 2, M)
        middle_index, ratios = len(measures) // 2, [np.zeros((1, *measures.shape[1:]))]
        for training, test in (
            (measures[:middle_index], measures[middle_index:]),
            (measures[middle_index:], measures[:middle_index]),
        ):
            if len(training) and len(test):
                ratios.append(_relative_to_others(np.nan_to_num(test / _usual_variation(training, noise))))
        max_ratios = np.concatenate(ratios).max(axis=(0, 2))
        limits = np.maximum(
            _MIN_LIMIT_RATIO,
            (_UNSTEADY_LIMIT_FACTOR + _UNSTEADY_LIMIT_FACTOR_INCREASE / max(len(measures), 1)) * max_ratios,
        )
        # With a coarse analogue-to-digital converter, a channel may read the same value throughout a window.
        differences = np.diff(steps, axis=0)
        can_be_stuck = np.isfinite(noise) & (
            np.sum(np.abs(differences) > 0, axis=0) > _MIN_MOVING_FRACTION * np.isfinite(differences).sum(axis=0)
        )
        return cls(_usual_variation(measures, noise), limits, can_be_stuck)

    def noisy_channels(
        self, steps: Float[np.ndarray, "2w M"], trusted: Bool[np.ndarray, " M"]
    ) -> Bool[np.ndarray, " M"]:
        """Return whether each channel is noisy, or jumps, in both of two windows, far more than nearly all other
        channels.

        `steps` (steps, channels): averaged frames of both windows, volts; `trusted`: whether each channel may be used.
        """
        middle_index, exceeds_by_window = len(steps) // 2, []
        for window_steps in (steps[:middle_index], steps[middle_index:]):
            ratios = np.where(trusted, np.nan_to_num(_variation_measures(window_steps) / self.usual_values), 0.0)
            exceeds_by_window.append((_relative_to_others(ratios) > self.limits[:, None]).any(axis=0))
        return self._exclude_common_changes(exceeds_by_window, trusted)

    def stuck_channels(
        self, steps: Float[np.ndarray, "2w M"], trusted: Bool[np.ndarray, " M"]
    ) -> Bool[np.ndarray, " M"]:
        """Return whether each channel is constant in both of two windows while other channels change; arguments: see
        `noisy_channels`."""
        middle_index = len(steps) // 2
        return self._exclude_common_changes(
            [
                (_variation_measures(window_steps)[1] == 0) & self.can_be_stuck
                for window_steps in (steps[:middle_index], steps[middle_index:])
            ],
            trusted,
        )

    @staticmethod
    def _exclude_common_changes(exceeds_by_window: list[np.ndarray], trusted: np.ndarray) -> Bool[np.ndarray, " M"]:
        is_unsteady = exceeds_by_window[0] & exceeds_by_window[1] & trusted
        # A channel that was steady in the first window is detected later; if too many channels are unsteady at once, no
        # channel is detected.
        max_num_channels = max(1, _MAX_UNSTEADY_FRACTION * trusted.sum())
        return (
            is_unsteady
            if 0 < is_unsteady.sum() <= max_num_channels
            and (exceeds_by_window[1] & trusted).sum() <= 2 * max_num_channels
            else np.zeros_like(is_unsteady)
        )


def _relative_to_others(ratios: Float[np.ndarray, "... M"]) -> Float[np.ndarray, "... M"]:
    """Divide the ratios of variation measures to their usual values by a high quantile over the channels, if it is
    above 1. A change of nearly all channels is then not attributed to single channels."""
    num_excluded = max(1, int(_MAX_UNSTEADY_FRACTION * ratios.shape[-1]))
    if num_excluded >= ratios.shape[-1]:
        return ratios
    return ratios / np.maximum(np.sort(ratios, axis=-1)[..., -(num_excluded + 1), None], 1.0)


def _variation_measures(window_steps: Float[np.ndarray, "w M"]) -> Float[np.ndarray, "2 M"]:
    """Compute the two measures (2, channels) of each channel's variation in a window of averaged frames (steps,
    channels).

    The measures are the mean of the smaller half of the magnitudes of changes from step to step, and the mean of all
    magnitudes; NaN for channels with too few readings.
    """
    magnitudes = np.sort(np.abs(np.diff(window_steps, axis=0)), axis=0)  # NaN last
    num_readings = np.isfinite(magnitudes).sum(axis=0)
    magnitudes, cumulative_sums = np.nan_to_num(magnitudes), np.cumsum(np.nan_to_num(magnitudes), axis=0)
    num_small_changes = np.maximum((_SMALLEST_CHANGES_FRACTION * num_readings).astype(int), 1)
    channels = np.arange(magnitudes.shape[1])
    measures = np.stack(
        [
            cumulative_sums[num_small_changes - 1, channels] / num_small_changes,
            cumulative_sums[-1] / np.maximum(num_readings, 1),
        ]
    )
    return np.where(num_readings >= max(2, _MIN_READ_FRACTION * len(magnitudes)), measures, np.nan)


def _usual_variation(measures: Float[np.ndarray, "n 2 M"], noise: Float[np.ndarray, " M"]) -> Float[np.ndarray, "2 M"]:
    """Compute the mean of the variation measures (windows, 2, channels) over healthy windows, but at least a tenth of
    the `noise`, since a coarse analogue-to-digital converter hides noise."""
    usual_values = np.nan_to_num(measures).mean(axis=0)
    return np.where(
        np.isfinite(noise), np.maximum(usual_values, 0.1 * np.where(np.isfinite(noise), noise, 1.0)), np.inf
    )
