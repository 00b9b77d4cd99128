"""Quality of the frames of a live session, computed from the latest frames: noise, reciprocity, and electrodes that are
dead or drift."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jeit.data import Measurement, reciprocity_error
from jeit.live.pictures import LiveFrame

# Number of latest frames from which the quality is computed, and minimum number of frames.
_NUM_FRAMES, _MIN_FRAMES = 32, 8
# Number of successive medians over the latest frames that are stored to detect drift.
_NUM_MEDIANS = 40
# A reading is lost if it is missing, or if its relative difference from the reference exceeds
# `_LOST_READING_DIFFERENCE`. An electrode is dead if at least the fraction `_DEAD_ELECTRODE_LOST_SHARE` of its readings
# is lost, not counting readings on other dead electrodes. An electrode drifts if the median relative difference of its
# readings exceeds `_MIN_DRIFT_DIFFERENCE`, and also `_MIN_DRIFT_RATIO` times the median difference of all other
# readings.
_LOST_READING_DIFFERENCE, _DEAD_ELECTRODE_LOST_SHARE, _MIN_DRIFT_DIFFERENCE, _MIN_DRIFT_RATIO = 0.5, 0.7, 0.05, 3.0
# The frames of a reference are divided into parts, whose means are compared. Number of parts; minimum number of frames
# of a part; ratio of the deviation of the means to the deviation expected from noise, above which the sensor is
# considered disturbed.
_NUM_PARTS_OF_REFERENCE, _MIN_PART_FRAMES, _MIN_DISTURBANCE_RATIO = 4, 2, 4.0
# Factor by which the frame rate must change for a report, and number of successive calls for which the change must
# last.
_MIN_RATE_CHANGE_FACTOR, _NUM_CALLS_WITH_CHANGED_RATE = 1.4, 3


@dataclass(frozen=True)
class Quality:
    """Quality of the latest frames. **Fields**: `noise`: standard deviation of a reading from frame to frame, relative
    to the root mean square of a frame; `reciprocity`: `jeit.data.reciprocity_error` of the mean of the latest frames;
    both None if unknown; `dead`, `drifting`: indices, from 0, of dead and of drifting electrodes."""

    noise: float | None = None
    reciprocity: float | None = None
    dead: Sequence[int] = ()
    drifting: Sequence[int] = ()


@np.errstate(all="ignore")  # readings of faulty frames may overflow
def change_during(frames: Float[np.ndarray, "N M"]) -> float | None:
    """Relative change of a sensor during `frames` (frames, channels): the largest norm of the difference between the
    mean of a quarter of the frames and the mean of all frames, divided by the norm of the mean of all frames. None for
    fewer than eight frames, for a change that noise explains, and for a change no larger than the noise of a single
    frame. The noise is estimated from successive frames."""
    frames = np.asarray(frames, float)[:, np.isfinite(frames).all(axis=0)]
    if len(frames) < _NUM_PARTS_OF_REFERENCE * _MIN_PART_FRAMES:
        return None
    deviations_of_parts = np.array(
        [frame_part.mean(axis=0) for frame_part in np.array_split(frames, _NUM_PARTS_OF_REFERENCE)]
    ) - frames.mean(axis=0)
    noise = (np.diff(frames, axis=0) ** 2).mean(axis=0).sum() / 2
    # A change smaller than the noise of a frame, such as a slow drift over thousands of frames, is harmless.
    if not (deviations_of_parts**2).sum() > (_NUM_PARTS_OF_REFERENCE - 1) * noise * max(
        _MIN_DISTURBANCE_RATIO**2 * _NUM_PARTS_OF_REFERENCE / len(frames), 1.0
    ):
        return None
    return float(np.sqrt((deviations_of_parts**2).sum(axis=1).max()) / np.linalg.norm(frames.mean(axis=0)))


class QualityWatch:
    """Computes the quality of the latest frames of a sensor. Several threads can use one object.

    `reference`: a measurement of the undisturbed sensor; without it, only the noise is estimated.
    """

    def __init__(self, reference: Measurement | None):
        self.protocol = None if reference is None else reference.protocol
        self.reference_voltages = self.touching = None
        self._lock = threading.Lock()
        self._frames: deque[np.ndarray] = deque(maxlen=_NUM_FRAMES)
        self._past_medians: deque[np.ndarray] = deque(maxlen=_NUM_MEDIANS)
        if reference is not None:
            self.replace_reference(np.where(reference.mask, np.real(np.asarray(reference.voltages)), np.nan))
            num_electrodes = reference.protocol.num_electrodes
            self.touching = np.array(
                [reference.protocol.channels_touching(electrode) for electrode in range(num_electrodes)]
            )

    def replace_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Replace the reference by the mean of `frames` (frames, channels)."""
        is_finite = np.isfinite(frames)
        channel_sums = np.where(is_finite, frames, 0.0).sum(axis=0)
        channel_means = np.where(is_finite.any(axis=0), channel_sums / np.maximum(is_finite.sum(axis=0), 1), np.nan)
        with self._lock:
            self.reference_voltages = channel_means
            self._past_medians.clear()

    def add(self, frame: LiveFrame) -> None:
        """Add a frame to the latest frames. Text, and frames with a different number of channels, are left out."""
        frame_values = frame.values
        if isinstance(frame_values, str) or frame_values.ndim != 1 or frame_values.dtype.kind not in "iuf":
            return
        if self.reference_voltages is not None and len(frame_values) != len(self.reference_voltages):
            return
        with self._lock:
            if self._frames and len(self._frames[0]) != len(frame_values):
                self._frames.clear()
            self._frames.append(frame_values)

    @np.errstate(all="ignore")  # squares of numbers that are no voltages may overflow
    def assess(self) -> Quality:
        """Compute the quality of the latest frames. Call this method about every half second."""
        with self._lock:
            if len(self._frames) < _MIN_FRAMES:
                return Quality()
            frames = np.array(self._frames, float)
            reference_voltages = self.reference_voltages
        frames[~np.isfinite(frames)] = np.nan
        noise = _relative_noise(frames)
        if reference_voltages is None or self.protocol is None or self.touching is None:
            return Quality(noise)
        is_known = np.isfinite(frames).sum(axis=0) > len(frames) // 2
        channel_medians = np.full(frames.shape[1], np.nan)
        channel_medians[is_known] = np.nanmedian(frames[:, is_known], axis=0)
        mean_reciprocity_error = None
        if is_known.any():
            median_measurement = Measurement(
                np.where(is_known, channel_medians, 0.0)[None], is_known[None], self.protocol
            )
            mean_reciprocity_error = reciprocity_error(median_measurement)
        with self._lock:
            self._past_medians.append(channel_medians)
            past_medians = np.array(self._past_medians)
        is_readable = np.isfinite(reference_voltages) & (reference_voltages != 0)
        relative_changes = np.abs(channel_medians - reference_voltages) / np.abs(
            np.where(is_readable, reference_voltages, 1.0)
        )
        dead_electrodes = _find_dead_electrodes(
            ~is_known | (relative_changes > _LOST_READING_DIFFERENCE), is_readable, self.touching
        )
        if len(past_medians) < _NUM_MEDIANS // 2:
            return Quality(noise, mean_reciprocity_error, dead_electrodes)
        has_drift_data = (
            np.isfinite(past_medians).all(axis=0) & is_readable & ~self.touching[dead_electrodes].any(axis=0)
        )
        drift_per_channel = np.zeros(len(reference_voltages))
        drift_per_channel[has_drift_data] = np.median(
            np.abs(past_medians[:, has_drift_data] / reference_voltages[has_drift_data] - 1), axis=0
        )
        return Quality(
            noise,
            mean_reciprocity_error,
            dead_electrodes,
            _find_drifting_electrodes(drift_per_channel, has_drift_data, self.touching),
        )


class RateWatch:
    """Detects lasting changes of a frame rate."""

    def __init__(self):
        self.usual_rate: float | None = None
        self._num_changed_rates = 0

    def __call__(self, rate: float) -> str:
        """Return a sentence if the `rate` in frames/s has changed, otherwise an empty string."""
        if rate <= 0:
            return ""
        if (
            self.usual_rate is not None
            and max(rate / self.usual_rate, self.usual_rate / rate) < _MIN_RATE_CHANGE_FACTOR
        ):
            self._num_changed_rates = 0
            return ""
        self._num_changed_rates += 1
        if self._num_changed_rates < _NUM_CALLS_WITH_CHANGED_RATE:
            return ""
        previous_rate, self.usual_rate, self._num_changed_rates = self.usual_rate, rate, 0
        return (
            ""
            if previous_rate is None
            else f"The frame rate has changed from {previous_rate:.3g} to {rate:.3g} frames a second."
        )


def _relative_noise(frames: Float[np.ndarray, "F M"]) -> float | None:
    """Estimate the relative noise of frames from second differences in time, which a linear change does not affect."""
    rms_voltage = np.sqrt(np.nanmean(frames**2)) if np.isfinite(frames).any() else 0.0
    second_differences = frames[:-2] - 2 * frames[1:-1] + frames[2:]
    second_differences = second_differences[np.isfinite(second_differences)]
    if not rms_voltage > 0 or not second_differences.size or not np.isfinite(rms_voltage):
        return None
    return float(1.4826 * np.median(np.abs(second_differences)) / np.sqrt(6) / rms_voltage)


def _find_dead_electrodes(
    is_lost: Bool[np.ndarray, " M"], is_readable: Bool[np.ndarray, " M"], is_electrode_channel: Bool[np.ndarray, "L M"]
) -> list[int]:
    """Find the electrodes most of whose readings are lost. The electrode with the largest fraction of lost readings is
    detected first; its channels are left out in the search for the next dead electrode."""
    dead_electrodes: list[int] = []
    is_remaining_channel = is_readable.copy()
    while is_remaining_channel.any():
        own_channels = is_electrode_channel & is_remaining_channel
        num_channels = own_channels.sum(axis=1)
        lost_reading_shares = np.where(
            num_channels > 0, (own_channels & is_lost).sum(axis=1) / np.maximum(num_channels, 1), 0.0
        )
        worst_electrode = int(lost_reading_shares.argmax())
        if lost_reading_shares[worst_electrode] < _DEAD_ELECTRODE_LOST_SHARE:
            break
        dead_electrodes.append(worst_electrode)
        is_remaining_channel &= ~is_electrode_channel[worst_electrode]
    return sorted(dead_electrodes)


def _find_drifting_electrodes(
    channel_drift: Float[np.ndarray, " M"],
    has_drift_data: Bool[np.ndarray, " M"],
    is_electrode_channel: Bool[np.ndarray, "L M"],
) -> list[int]:
    """Find the electrodes whose readings have a large `channel_drift`, much larger than that of the readings of other
    electrodes."""
    drifting_electrodes: list[int] = []
    is_remaining_channel = has_drift_data.copy()
    while True:
        own_channels = [
            is_electrode_channel[electrode_index] & is_remaining_channel
            for electrode_index in range(len(is_electrode_channel))
        ]
        median_drifts = np.array(
            [np.median(channel_drift[channel_mask]) if channel_mask.any() else 0.0 for channel_mask in own_channels]
        )
        worst_electrode = int(median_drifts.argmax())
        channels_of_others = is_remaining_channel & ~is_electrode_channel[worst_electrode]
        if (
            median_drifts[worst_electrode] < _MIN_DRIFT_DIFFERENCE
            or not channels_of_others.any()
            or median_drifts[worst_electrode] < _MIN_DRIFT_RATIO * np.median(channel_drift[channels_of_others])
        ):
            return sorted(drifting_electrodes)
        drifting_electrodes.append(worst_electrode)
        is_remaining_channel = channels_of_others
