"""Events in the state of a monitored skin, and detection of lasting steps in the skin's frames.

A lasting step of the voltages is detected in frames with touches, noise and drift by comparing the medians of two
consecutive windows of frames. A touch is shorter than half a window, so it hardly affects the window's median. Drift
also changes the voltages within a window, whereas a step occurs at one time. In every channel, the size of a step is
relative to the usual change between windows of healthy frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr

from jeit_solvers.module import Module


class EventKind(StrEnum):
    """Kind of an event in the state of a skin. Each member equals its string value."""

    CUT = "cut"
    """Conductivity is permanently lost along a path."""
    DEAD = "dead electrode"
    """The channels of an electrode have changed by far more than a change of its contact explains."""
    TORN = "torn wire"
    """The channels of an electrode read almost nothing, or all the same constant; a dead electrode may have the same
    effect."""
    LOOSE = "loose electrode"
    """The contact of an electrode has become worse, and fluctuates."""
    NOISY = "noisy channel"
    """A single channel has several times its usual noise, or jumps."""
    STUCK = "stuck channel"
    """A single channel no longer changes, while others do."""
    CHANGED = "changed"
    """The skin has changed, but frames alone do not determine how, or no model explains the change."""
    REPAIRED = "repaired"
    """A change has disappeared, or the user has reported a repair."""


class EventStatus(StrEnum):
    """How certain an event in the state of a skin is. Each member equals its string value."""

    HELD = "held, or a void"
    """The change may be damage or a touch that is held: only its duration or the user can distinguish the two."""
    LASTING = "lasting"
    """The change has lasted longer than any touch, or is unlike any touch."""
    CONFIRMED = "confirmed"
    DENIED = "denied"
    MENDED = "mended"
    """The change has disappeared: it was mended, or was a press held for an unusually long time."""


class WatchStatus(StrEnum):
    """How a frame of a monitored skin was processed. Each member equals its string value."""

    WATCHED = "watched"
    PARTIAL = "partial"
    """Processed, but some of its channels are not usable."""
    REFUSED = "refused"
    """Not processed: it has too few readings, or its time is not after that of the last frame."""


class HealthEvent(Module):
    """An event in the state of a monitored skin, such as a cut or a failing electrode.

    **Fields**: `number`: position among events in order of detection; `kind`; `status`; `time`: time at which the event
    began; `noticed`: time at which the event was detected, both in seconds (in frames if frames have no times);
    `frame`: number of the frame at which the event began; `channels`: whether each channel changed; `change`: change of
    each channel, volts; `strength`: size of the change divided by the limit learnt from healthy frames; `electrode`:
    number of the failing electrode, from 0, or None; `path` (points, 2): path of a cut, metres, or None; `deviation`:
    standard deviation of the path's `length`, metres, estimated from the voltages; `through`: whether the whole depth
    of the skin is cut, or None; `reason`: a sentence that explains the event.

    **Example:**

    ```python
    events = watch(health, damaged).events
    print([(event.kind, event.frame) for event in events if isinstance(event, HealthEvent)])
    ```
    """

    number: int
    kind: EventKind
    status: EventStatus
    time: float
    noticed: float
    frame: int
    channels: Bool[np.ndarray, " M"]
    change: Float[np.ndarray, " M"]
    strength: float
    electrode: int | None = None
    path: Float[np.ndarray, "k 2"] | None = None
    deviation: float = 0.0
    through: bool | None = None
    reason: str = ""

    @property
    def length(self) -> float:
        """Length of the path of a cut, metres; 0 for an event without a path."""
        return 0.0 if self.path is None else float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())

    @property
    def open(self) -> bool:
        """Whether the event still applies: the event is neither denied nor mended, and is not a repair."""
        is_closed = self.status in (EventStatus.DENIED, EventStatus.MENDED)
        return not is_closed and self.kind != EventKind.REPAIRED


# Minimum sharpness of a step: difference of the medians over a quarter of a window after and before the step, as a
# fraction of the step; for a constant slope, it is a quarter.
_MIN_SHARPNESS = 0.55
# Fraction of a step that the median of each third of the frames after the step must exceed.
_MIN_FRACTION_AFTER = 0.5
# Fraction of a step that the median of no third of the frames before the step may exceed.
_MAX_FRACTION_BEFORE = 0.5
# Fraction of a step below which the level of a frame counts as the level before the step.
_MAX_FRACTION_OF_LEVEL_BEFORE = 0.3
# Maximum fraction of frames on one side of the step with the level of the other side, which touches of the opposite
# sign may cause.
_MAX_OUTLIER_FRACTION = 0.1
# Exponent of the power mean over channels, large enough to detect a change of a single channel among many.
_POWER_MEAN_EXPONENT = 4


@dataclass(frozen=True)
class Step:
    """A step of the voltages between two consecutive windows of frames.

    **Fields**: `change`: change of each channel, volts; `size`: size of the change relative to changes between healthy
    windows; `first_frame`: index, among the frames of both windows, of the first frame after the step.
    """

    change: Float[np.ndarray, " M"]
    size: float
    first_frame: int


def window_change(frames: Float[np.ndarray, "2w M"]) -> Float[np.ndarray, " M"]:
    """Compute the change of each channel from the median of the first half of frames to that of the second half; NaN if
    a half has no reading."""
    window_length = len(frames) // 2
    return channel_medians(frames[window_length:]) - channel_medians(frames[:window_length])


def channel_medians(frames: Float[np.ndarray, "n M"]) -> Float[np.ndarray, " M"]:
    """Compute the median of every channel over the frames with a reading; NaN for channels without readings."""
    if not np.isnan(frames).any():
        return np.median(frames, axis=0)
    has_readings = ~np.isnan(frames).all(axis=0)
    medians = np.full(frames.shape[1], np.nan)
    medians[has_readings] = np.nanmedian(frames[:, has_readings], axis=0)
    return medians


def change_size(scaled_changes: Float[np.ndarray, "... M"]) -> Float[np.ndarray, "..."]:
    """Compute the size of voltage changes that are divided by the usual healthy changes: a power mean over the channels
    with a reading."""
    change_powers = np.minimum(np.abs(scaled_changes), 1e9) ** _POWER_MEAN_EXPONENT
    has_reading = np.isfinite(change_powers)
    mean_powers = np.sum(np.where(has_reading, change_powers, 0.0), axis=-1) / np.maximum(has_reading.sum(axis=-1), 1)
    return mean_powers ** (1 / _POWER_MEAN_EXPONENT)


def lasting_step(frames: Float[np.ndarray, "2w M"], scale: Float[np.ndarray, " M"], limit: float) -> Step | None:
    """Find a lasting step of the voltages between two windows: the first and the second half of frames (frames,
    channels).

    `scale`: usual healthy change of each channel. Returns None unless the step between the medians of the two windows
    exceeds the `limit`, in units of `scale`, is sharp, and lasts to the end of the second window.
    """
    voltage_change = window_change(frames)
    size_of_change = float(change_size(voltage_change / scale))
    if size_of_change <= limit:
        return None
    step_direction = np.nan_to_num(voltage_change / scale**2)
    window_length = len(frames) // 2
    initial_medians = np.where(np.isfinite(voltage_change), channel_medians(frames[:window_length]), 0.0)
    complete_frames = np.where(np.isfinite(frames), frames, initial_medians)
    # Component of the frames along the step: 0 before the step, 1 after the step.
    step_projections = (
        (complete_frames - initial_medians)
        @ step_direction
        / max(np.nan_to_num(voltage_change) @ step_direction, 1e-300)
    )
    first_frame = _best_step_index(np.clip(step_projections, -1.0, 2.0), window_length)
    quarter_window_length = max(2, window_length // 4)
    if first_frame < window_length // 2 or first_frame + quarter_window_length > len(step_projections):
        return None
    step_sharpness = np.median(step_projections[first_frame : first_frame + quarter_window_length]) - np.median(
        step_projections[max(0, first_frame - quarter_window_length) : first_frame]
    )
    median_projections_after = [
        np.median(third_of_projections) for third_of_projections in np.array_split(step_projections[first_frame:], 3)
    ]
    median_projections_before = [
        np.median(third_of_projections) for third_of_projections in np.array_split(step_projections[:first_frame], 3)
    ]
    if (
        step_sharpness < _MIN_SHARPNESS
        or min(median_projections_after) < _MIN_FRACTION_AFTER
        or max(median_projections_before) > _MAX_FRACTION_BEFORE
        or not is_distinct(step_projections, first_frame)
    ):
        return None
    # The step need not be at the boundary between the windows.
    return Step(
        channel_medians(frames[first_frame:]) - channel_medians(frames[:first_frame]), size_of_change, first_frame
    )


def is_distinct(projections: Float[np.ndarray, " n"], first_frame: int) -> bool:
    """Return whether the levels of frames are 0 before index `first_frame` and 1 from this index on, apart from noise
    and a few exceptions.

    A lasting step is distinct from two touches, between which the level returns to 0.
    """
    projection_noise = 1.4826 * np.median(np.abs(np.diff(projections))) / np.sqrt(2)
    max_outlier_fraction = max(
        _MAX_OUTLIER_FRACTION, 1.5 * float(ndtr((_MAX_FRACTION_OF_LEVEL_BEFORE - 1) / max(projection_noise, 1e-12)))
    )
    outlier_fraction_before = (
        np.mean(projections[:first_frame] > 1 - _MAX_FRACTION_OF_LEVEL_BEFORE) if first_frame else 0.0
    )
    return bool(
        np.mean(projections[first_frame:] < _MAX_FRACTION_OF_LEVEL_BEFORE) <= max_outlier_fraction
        and outlier_fraction_before <= max_outlier_fraction
    )


def _best_step_index(frame_projections: np.ndarray, window_length: int) -> int:
    """Find the index at which the levels of frames are best split into two constant parts by least squares."""
    num_frames = len(frame_projections)
    sum_of_projections, cumulative_projections = frame_projections.sum(), np.cumsum(frame_projections)[:-1]
    num_frames_before = np.arange(1, num_frames)
    between_sum_of_squares = cumulative_projections**2 / num_frames_before + (
        sum_of_projections - cumulative_projections
    ) ** 2 / (num_frames - num_frames_before)
    allowed_split_indices = slice(max(3, window_length // 2) - 1, num_frames - 3)
    return int(np.argmax(between_sum_of_squares[allowed_split_indices])) + int(allowed_split_indices.start) + 1
