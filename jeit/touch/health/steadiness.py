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
_MIN_VARIATION_LIMIT = 3.0
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
        window_starts = range(0, max(1, len(steps) - window + 1), max(1, window // 2))
        window_variations = np.array(
            [_variation_measures(steps[window_start : window_start + window]) for window_start in window_starts]
        )  # (windows, 2, M)
        middle_index, variation_ratios = len(window_variations) // 2, [np.zeros((1, *window_variations.shape[1:]))]
        for training_variations, test_variations in (
            (window_variations[:middle_index], window_variations[middle_index:]),
            (window_variations[middle_index:], window_variations[:middle_index]),
        ):
            if len(training_variations) and len(test_variations):
                variation_ratios.append(
                    _relative_to_others(np.nan_to_num(test_variations / _usual_variation(training_variations, noise)))
                )
        max_variation_ratios = np.concatenate(variation_ratios).max(axis=(0, 2))
        limits = np.maximum(
            _MIN_VARIATION_LIMIT,
            (_UNSTEADY_LIMIT_FACTOR + _UNSTEADY_LIMIT_FACTOR_INCREASE / max(len(window_variations), 1))
            * max_variation_ratios,
        )
        # With a coarse analogue-to-digital converter, a channel may read the same value throughout a window.
        frame_differences = np.diff(steps, axis=0)
        can_be_stuck = np.isfinite(noise) & (
            np.sum(np.abs(frame_differences) > 0, axis=0)
            > _MIN_MOVING_FRACTION * np.isfinite(frame_differences).sum(axis=0)
        )
        return cls(_usual_variation(window_variations, noise), limits, can_be_stuck)

    def noisy_channels(
        self, steps: Float[np.ndarray, "2w M"], trusted: Bool[np.ndarray, " M"]
    ) -> Bool[np.ndarray, " M"]:
        """Return whether each channel is noisy, or jumps, in both of two windows, far more than nearly all other
        channels.

        `steps` (steps, channels): averaged frames of both windows, volts; `trusted`: whether each channel may be used.
        """
        middle_index, is_unsteady_by_window = len(steps) // 2, []
        for window_steps in (steps[:middle_index], steps[middle_index:]):
            variation_ratios = np.where(
                trusted, np.nan_to_num(_variation_measures(window_steps) / self.usual_values), 0.0
            )
            is_unsteady_by_window.append((_relative_to_others(variation_ratios) > self.limits[:, None]).any(axis=0))
        return self._exclude_common_changes(is_unsteady_by_window, trusted)

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
    def _exclude_common_changes(
        is_unsteady_by_window: list[np.ndarray], trusted_channels: np.ndarray
    ) -> Bool[np.ndarray, " M"]:
        is_unsteady = is_unsteady_by_window[0] & is_unsteady_by_window[1] & trusted_channels
        # A channel that was steady in the first window is detected later; if too many channels are unsteady at once, no
        # channel is detected.
        max_num_unsteady = max(1, _MAX_UNSTEADY_FRACTION * trusted_channels.sum())
        return (
            is_unsteady
            if 0 < is_unsteady.sum() <= max_num_unsteady
            and (is_unsteady_by_window[1] & trusted_channels).sum() <= 2 * max_num_unsteady
            else np.zeros_like(is_unsteady)
        )


def _relative_to_others(variation_ratios: Float[np.ndarray, "... M"]) -> Float[np.ndarray, "... M"]:
    """Divide the ratios of variation measures to their usual values by a high quantile over the channels, if it is
    above 1. A change of nearly all channels is then not attributed to single channels."""
    num_excluded_channels = max(1, int(_MAX_UNSTEADY_FRACTION * variation_ratios.shape[-1]))
    if num_excluded_channels >= variation_ratios.shape[-1]:
        return variation_ratios
    return variation_ratios / np.maximum(
        np.sort(variation_ratios, axis=-1)[..., -(num_excluded_channels + 1), None], 1.0
    )


def _variation_measures(window_steps: Float[np.ndarray, "w M"]) -> Float[np.ndarray, "2 M"]:
    """Compute the two measures (2, channels) of each channel's variation in a window of averaged frames (steps,
    channels).

    The measures are the mean of the smaller half of the magnitudes of changes from step to step, and the mean of all
    magnitudes; NaN for channels with too few readings.
    """
    change_magnitudes = np.sort(np.abs(np.diff(window_steps, axis=0)), axis=0)  # NaN last
    num_readings = np.isfinite(change_magnitudes).sum(axis=0)
    change_magnitudes, cumulative_changes = (
        np.nan_to_num(change_magnitudes),
        np.cumsum(np.nan_to_num(change_magnitudes), axis=0),
    )
    num_small_changes = np.maximum((_SMALLEST_CHANGES_FRACTION * num_readings).astype(int), 1)
    channels = np.arange(change_magnitudes.shape[1])
    variation_measures = np.stack(
        [
            cumulative_changes[num_small_changes - 1, channels] / num_small_changes,
            cumulative_changes[-1] / np.maximum(num_readings, 1),
        ]
    )
    return np.where(num_readings >= max(2, _MIN_READ_FRACTION * len(change_magnitudes)), variation_measures, np.nan)


def _usual_variation(
    window_variations: Float[np.ndarray, "n 2 M"], noise: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "2 M"]:
    """Compute the mean of the variation measures (windows, 2, channels) over healthy windows, but at least a tenth of
    the `noise`, since a coarse analogue-to-digital converter hides noise."""
    mean_variations = np.nan_to_num(window_variations).mean(axis=0)
    return np.where(
        np.isfinite(noise), np.maximum(mean_variations, 0.1 * np.where(np.isfinite(noise), noise, 1.0)), np.inf
    )
