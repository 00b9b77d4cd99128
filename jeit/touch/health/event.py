"""Events of a skin: what has changed, and what lasts.

Detect a lasting step in frames with touches, noise and drift, by comparing the medians of two windows.

A touch is shorter than half a window, so that it hardly affects the median of the window; drift within a window is as
large as between two; what is left is a step. The change between windows of healthy frames, channel by channel, is the
scale of steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr


class EventKind(StrEnum):
    """The kind of an event. Each is equal to its word."""

    CUT = "cut"
    """Conductivity is permanently lost along a path."""
    DEAD = "dead electrode"
    """An electrode's channels have changed by far more than its contact ever did."""
    TORN = "torn wire"
    """An electrode's channels read next to nothing, or one constant; a dead electrode may look the same."""
    LOOSE = "loose electrode"
    """An electrode's contact is worse, and fluctuates."""
    NOISY = "noisy channel"
    """A single channel has several times its noise, or jumps."""
    STUCK = "stuck channel"
    """A single channel no longer changes, while others do."""
    CHANGED = "changed"
    """The skin has changed; frames alone do not determine how, or no model explains it."""
    REPAIRED = "repaired"
    """A change has disappeared, or the user has reported a repair."""


class EventStatus(StrEnum):
    """How certain an event is. Each is equal to its word."""

    HELD = "held, or a void"
    """It looks like a touch that is held: only time or the user can distinguish the two."""
    LASTING = "lasting"
    """It has lasted longer than every touch, or is unlike any."""
    CONFIRMED = "confirmed"
    DENIED = "denied"
    MENDED = "mended"
    """It has disappeared: mended, or a press that was held longer than any was assumed to be."""


class HealthEvent(eqx.Module):
    """An event in the state of a skin.

    **Fields**: `number`, in the order of detection; `kind`; `status`; `time`, when it began, and `noticed`, when it was
    detected, both seconds (frames, where there are no times); `frame`, the number of the frame at which it began;
    `channels` (M,) that changed; `change` (M,), by how much, volts; `strength`: the ratio to the greatest change among
    healthy frames; `electrode`, its number from 0, or None; `path` (k, 2) of a cut, metres, or None, its `length`,
    metres, and the standard `deviation` of the length, estimated from the voltages; `through`, whether all of the
    skin's depth is cut, or None; `reason`, a sentence.
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
        """Length of the path, metres; 0 where there is none."""
        return 0.0 if self.path is None else float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())

    @property
    def open(self) -> bool:
        """Whether the event still applies: neither denied nor mended, and no repair."""
        gone = self.status in (EventStatus.DENIED, EventStatus.MENDED)
        return not gone and self.kind != EventKind.REPAIRED


# The least share of a step between the quarters of a window right before and after it; a slope has a quarter.
_SHARP = 0.55
# The share of a step that all thirds of the window after it exceed, and that the window before it does not.
_STAYED, _NOT_YET = 0.5, 0.5
# A frame below this share of the step is as before it; the share of frames that may be so, by touches of the opposite
# sign.
_BACK, _SOME = 0.3, 0.1
# Exponent of the mean, so high that a change of a single channel among many is detected.
_POWER = 4


@dataclass(frozen=True)
class Step:
    """A step between two windows.

    **Fields**: `change` (M,) from window to window; `size`, in the scale of healthy windows; `first`: the index of its
    first time step in both windows.
    """

    change: Float[np.ndarray, " M"]
    size: float
    first: int


def window_change(frames: Float[np.ndarray, "2w M"]) -> Float[np.ndarray, " M"]:
    """Change from the median of the first half of frames to that of the second, 0 where a half has no reading."""
    half = len(frames) // 2
    return median(frames[half:]) - median(frames[:half])


def median(frames: Float[np.ndarray, "n M"]) -> Float[np.ndarray, " M"]:
    """Median of every channel over its readings; NaN where there are none."""
    if not np.isnan(frames).any():
        return np.median(frames, axis=0)
    some = ~np.isnan(frames).all(axis=0)
    found = np.full(frames.shape[1], np.nan)
    found[some] = np.nanmedian(frames[:, some], axis=0)
    return found


def size_of(scaled: Float[np.ndarray, "... M"]) -> Float[np.ndarray, "..."]:
    """Size of changes in the scale of healthy ones; channels without a reading are left out."""
    powers = np.minimum(np.abs(scaled), 1e9) ** _POWER
    there = np.isfinite(powers)
    mean = np.sum(np.where(there, powers, 0.0), axis=-1) / np.maximum(there.sum(axis=-1), 1)
    return mean ** (1 / _POWER)


def lasting_step(frames: Float[np.ndarray, "2w M"], scale: Float[np.ndarray, " M"], limit: float) -> Step | None:
    """Find the step between two windows of frames (2w, M).

    Returns None unless it is above the `limit`, is sharp, and lasts for all of the second window.
    """
    change = window_change(frames)
    size = float(size_of(change / scale))
    if size <= limit:
        return None
    direction = np.nan_to_num(change / scale**2)
    half = len(frames) // 2
    before = np.where(np.isfinite(change), median(frames[:half]), 0.0)
    readings = np.where(np.isfinite(frames), frames, before)
    # 0 before the step, 1 after it.
    along = (readings - before) @ direction / max(np.nan_to_num(change) @ direction, 1e-300)
    first = _split(np.clip(along, -1.0, 2.0), half)
    quarter = max(2, half // 4)
    if first < half // 2 or first + quarter > len(along):
        return None
    sharp = np.median(along[first : first + quarter]) - np.median(along[max(0, first - quarter) : first])
    thirds = [np.median(part) for part in np.array_split(along[first:], 3)]
    earlier = [np.median(part) for part in np.array_split(along[:first], 3)]
    if sharp < _SHARP or min(thirds) < _STAYED or max(earlier) > _NOT_YET or not is_distinct(along, first):
        return None
    # The step need not be where the windows meet.
    return Step(median(frames[first:]) - median(frames[:first]), size, first)


def is_distinct(along: Float[np.ndarray, " n"], first: int) -> bool:
    """Whether frames are 0 before the `first` and 1 from it on, but for noise and a few.

    Between two touches, in contrast, frames return to 0.
    """
    noise = 1.4826 * np.median(np.abs(np.diff(along))) / np.sqrt(2)
    most = max(_SOME, 1.5 * float(ndtr((_BACK - 1) / max(noise, 1e-12))))
    early = np.mean(along[:first] > 1 - _BACK) if first else 0.0
    return bool(np.mean(along[first:] < _BACK) <= most and early <= most)


def _split(along: np.ndarray, half: int) -> int:
    """Find the index at which splitting into two constants fits best."""
    number = len(along)
    total, sums = along.sum(), np.cumsum(along)[:-1]
    count = np.arange(1, number)
    between = sums**2 / count + (total - sums) ** 2 / (number - count)
    allowed = slice(max(3, half // 2) - 1, number - 3)
    return int(np.argmax(between[allowed])) + int(allowed.start) + 1
