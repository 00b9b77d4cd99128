"""`SkinHealth`: monitor a skin from frame to frame, to detect damage and repairs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jeit.arguments import check_kind, describe, is_number, real_array
from jeit.forward import ForwardModel
from jeit.forward.model import check_model
from jeit.protocol import Protocol
from jeit.touch.health.event import (
    EventKind,
    EventStatus,
    HealthEvent,
    Step,
    WatchStatus,
    change_size,
    channel_medians,
    is_distinct,
    lasting_step,
)
from jeit.touch.health.finding import Finding, ImagedSkin, LastingChange, classify_change
from jeit.touch.health.healthy import HealthyState, average_frames, check_frames, check_times
from jeit.touch.health.record import CHANNEL_KINDS, MIN_DISAPPEARED_FRACTION, HealthRecord

# Patience, a time longer than any touch is held, in seconds.
DEFAULT_PATIENCE = 30.0
# Patience as a number of windows, for frames without times.
_PATIENCE_WINDOWS = 3
# Ratio of the patience to the length of a window of frames.
_PATIENCE_PER_WINDOW = 3.0
# Weight of the latest window in the update of the reference, every quarter of a window.
_REFERENCE_WEIGHT = 0.1
# Minimum fraction of channels with a reading, below which a frame is refused.
_MIN_READ_FRACTION = 0.5
# Multiple of the span of healthy changes beyond which a channel is faulty.
_FAULTY_SPAN_RATIO = 3.0
# Maximum fraction of channels that may be beyond this multiple of the span at once.
_MAX_OUTLIER_FRACTION = 0.34

# Appended to the reason of an event that is detected in the first window of frames.
_FIRST_WINDOW_NOTE = (
    "The change is present from the first frame on: gains or contacts that changed since the healthy "
    "recording have the same effect."
)


@dataclass(frozen=True)
class _PendingChange:
    """A change that a touch may also cause; it is pending until it disappears or has lasted longer than any touch."""

    change: LastingChange
    finding: Finding


@dataclass(frozen=True)
class SkinHealth:
    """State of a monitored skin.

    `health.follow(time, frame)` returns the state after the next frame; `health` is not changed. Every quarter of a
    window of frames, the medians of the last two windows are compared. A step of the voltages between the windows is a
    change of the skin if the step is larger than any in the healthy frames, sharp, and lasting. A change unlike any
    healthy touch is reported at once. A change that a touch may also cause is reported when it has lasted for
    `patience` seconds, because it may be a held press. The reference voltages follow drift.

    **Fields**: `record`: what is known about the skin: reference voltages, trusted channels, events, and a model of the
    skin, if given; `patience`: time longer than any touch is held, seconds; `time`: time of the last frame; `frames`:
    number of frames so far, with refused frames; `status`: status of the last frame; `usable`: whether each channel is
    trusted and has a plausible reading in the last frame; `reason`: a sentence that explains the status.

    Create a state with `SkinHealth.fit`.

    **Example:**

    ```python
    health = SkinHealth.fit(healthy)
    print(watch(health, damaged).events)
    ```
    """

    record: HealthRecord
    patience: float
    time: float = -np.inf
    frames: int = 0
    status: WatchStatus = WatchStatus.WATCHED
    usable: Bool[np.ndarray, " M"] | None = None
    reason: str = ""
    _window: tuple[tuple[float, int, np.ndarray], ...] = ()
    _part: tuple[np.ndarray, ...] = ()
    _steps: int = 0
    _settled: bool = False
    _pending: _PendingChange | None = None

    @classmethod
    def fit(
        cls,
        healthy: ArrayLike,
        times: ArrayLike | None = None,
        *,
        patience: float | None = None,
        protocol: Protocol | None = None,
        model: ForwardModel | None = None,
        conductivity: ArrayLike | None = None,
        sign: int = 1,
    ) -> "SkinHealth":
        """Learn the healthy state from frames (frames, channels) of voltages or voltage changes, which should include
        touches.

        `times`: times of the frames, seconds; if None, frames are counted. `patience`: time longer than any touch is
        held, by default 30 s; without `times`, in frames, by default three windows. `protocol`: measurement protocol,
        to identify failing electrodes. `model`, `conductivity`, `sign`: forward model of the skin, its conductivity,
        S/m (2-D: S), and 1 if touched skin conducts better, -1 if worse; with these, cuts are located. Raises
        `ValueError` for frames whose channels are not those of the protocol, fewer than 20 frames, times that do not
        rise, and a patience that is not positive.
        """
        frames = check_frames("healthy", healthy)
        frame_period = 1.0
        if times is not None:
            frame_times = check_times(times, len(frames))
            if (np.diff(frame_times) <= 0).any():
                raise ValueError("times must increase from frame to frame, in seconds; some do not.")
            frame_period = float(np.median(np.diff(frame_times))) if len(frame_times) > 1 else 1.0
        if patience is not None and not (is_number(patience) and patience > 0):
            raise ValueError(f"patience must be positive, in seconds; it is {describe(patience)}.")
        wanted_patience = DEFAULT_PATIENCE if times is not None and patience is None else patience
        state = HealthyState.learn(
            frames, frame_period, None if wanted_patience is None else float(wanted_patience) / _PATIENCE_PER_WINDOW
        )
        window_time = state.window * state.stride * state.period
        wanted_patience = max(
            _PATIENCE_WINDOWS * window_time if wanted_patience is None else float(wanted_patience), 2 * window_time
        )
        skin = None
        if model is not None:
            check_model(model)
            if conductivity is None:
                raise ValueError("conductivity: give that of the model's healthy skin, S/m (2-D: S).")
            skin = ImagedSkin.create(model, conductivity, state.reference, state.noise, sign)
            protocol = model.protocol
        touching = None
        if protocol is not None:
            check_kind("protocol", protocol, Protocol, "a Protocol, such as adjacent(16)")
            if protocol.num_measurements != frames.shape[1]:
                raise ValueError(
                    f"healthy has {frames.shape[1]} channels, and the protocol {protocol.num_measurements}; give both "
                    "of one skin."
                )
            touching = np.array([protocol.channels_touching(electrode) for electrode in range(protocol.num_electrodes)])
        return cls(HealthRecord(state, state.reference, state.used, skin, touching), wanted_patience)

    @property
    def healthy(self) -> HealthyState:
        """Healthy state."""
        return self.record.healthy

    @property
    def reference(self) -> Float[np.ndarray, " M"]:
        """Present voltages (M,) of the untouched skin, volts."""
        return self.record.reference

    @property
    def trusted(self) -> Bool[np.ndarray, " M"]:
        """Whether each channel has readings and no open event excludes it, (M,)."""
        return self.record.trusted

    @property
    def skin(self) -> ImagedSkin | None:
        """Model of the skin with its cuts, or None."""
        return self.record.skin

    @property
    def events(self) -> tuple[HealthEvent, ...]:
        """Events so far."""
        return self.record.events

    def follow(self, time: float, frame: ArrayLike) -> "SkinHealth":
        """Return the state after a frame (channels,) at `time`, seconds; NaN marks a channel without a reading.

        A frame is refused if its time is not after that of the last frame, or if fewer than half of its channels have a
        reading; then `status` and `reason` say so. Raises `ValueError` for an invalid time or number of channels.
        """
        if not is_number(time):
            raise ValueError(f"time must be seconds; it is {describe(time)}.")
        voltages = real_array("frame", frame, f"{self.reference.size} voltages")
        if voltages.shape != self.reference.shape:
            raise ValueError(
                f"frame has shape {voltages.shape}; this skin has {self.reference.size} channels, as its healthy "
                "frames."
            )
        has_reading = np.isfinite(voltages) & self.healthy.used
        if not time > self.time:
            reason = f"Its time is not later than that of the frame before, {self.time:g}."
        elif has_reading.sum() < _MIN_READ_FRACTION * self.healthy.used.sum():
            reason = f"Only {int(has_reading.sum())} of {int(self.healthy.used.sum())} channels have a reading."
        else:
            return self._process_frame(float(time), voltages, has_reading)
        is_usable = np.zeros_like(has_reading)
        return replace(self, frames=self.frames + 1, status=WatchStatus.REFUSED, reason=reason, usable=is_usable)

    def confirm(self, event: HealthEvent) -> "SkinHealth":
        """Return the state after the user has confirmed an event; the event may be the pending event `held`.

        Raises `ValueError` for an event of another skin.
        """
        if self._pending is not None and self.held is not None and event.number == self.held.number:
            record = self.record.add_events(self._pending.change, [self._pending.finding], EventStatus.CONFIRMED)
            return replace(self, record=record, _pending=None)
        return replace(self, record=self.record.set_event_status(event, EventStatus.CONFIRMED))

    def deny(self, event: HealthEvent) -> "SkinHealth":
        """Return the state after the user has denied an event because it was a held press, not damage.

        The reference voltages are reset to those before the event. Raises `ValueError` for an event of a different
        skin.
        """
        if self._pending is not None and self.held is not None and event.number == self.held.number:
            return replace(self, _pending=None)
        return replace(self, record=self.record.deny_event(event))

    def repaired(self, frames: ArrayLike) -> "SkinHealth":
        """Return the state after the user has repaired the skin; the status of all open events becomes "mended".

        The median of the `frames` of the repaired, untouched skin, volts, is the new reference. The method may also be
        called before the first frame of a later day, with untouched frames of that day: changes in the meantime, such
        as of gains, are then not reported as events. Raises `ValueError` for a different number of channels, or
        readings in fewer than half of them.
        """
        checked_frames = check_frames("frames", np.atleast_2d(real_array("frames", frames, "(n, M) volts")))
        if checked_frames.shape[1] != self.reference.size:
            raise ValueError(f"frames have {checked_frames.shape[1]} channels, and this skin {self.reference.size}.")
        new_reference = channel_medians(np.where(np.isfinite(checked_frames), checked_frames, np.nan))
        has_reading = np.isfinite(new_reference) & self.healthy.used
        if has_reading.sum() < _MIN_READ_FRACTION * self.healthy.used.sum():
            raise ValueError("frames: fewer than half of the channels have a reading; that is no reference.")
        return replace(
            self,
            record=self.record.mend_all_events(new_reference, self.time, self.frames),
            _window=(),
            _part=(),
            _settled=True,
            _pending=None,
        )

    def images(self, frames: ArrayLike) -> Float[np.ndarray, "F m"]:
        """Reconstruct conductivity changes (frames, cells), S/m (2-D: S), relative to the present skin with its cuts.

        Only trusted channels are used; the image of a frame without a reading is NaN. Raises `ValueError` without a
        forward model, and for frames with a different number of channels.
        """
        if self.skin is None:
            raise ValueError("images need a forward model: give model and conductivity to SkinHealth.fit.")
        checked_frames = check_frames("frames", frames)
        if checked_frames.shape[1] != self.reference.size:
            raise ValueError(f"frames have {checked_frames.shape[1]} channels, and this skin {self.reference.size}.")
        return self.skin.images(checked_frames - self.reference, self.trusted)

    @property
    def held(self) -> HealthEvent | None:
        """Pending event, which may be a held touch or damage until its duration or the user decides; None if no event
        is pending."""
        if self._pending is None:
            return None
        return self.record.create_event(self._pending.change, self._pending.finding, EventStatus.HELD)

    @property
    def open_events(self) -> list[HealthEvent]:
        """The events that still apply: neither denied nor mended, and no repairs."""
        return self.record.open_events

    def _process_frame(self, time: float, voltages: np.ndarray, has_reading: np.ndarray) -> "SkinHealth":
        healthy = self.healthy
        lower_limits, upper_limits = healthy.span + self.reference
        margins = _FAULTY_SPAN_RATIO * (upper_limits - lower_limits) + healthy.limit * np.where(
            healthy.used, healthy.noise, 0.0
        )
        is_outlier = has_reading & ((voltages < lower_limits - margins) | (voltages > upper_limits + margins))
        # If many channels are beyond their healthy span, the skin has changed; the channels are not faulty.
        is_outlier &= is_outlier.sum() <= _MAX_OUTLIER_FRACTION * healthy.used.sum()
        usable = has_reading & self.trusted & ~is_outlier
        num_lost = int((healthy.used & ~usable).sum())
        status, reason = WatchStatus.WATCHED, ""
        if num_lost:
            status, reason = (
                WatchStatus.PARTIAL,
                f"{num_lost} of {int(healthy.used.sum())} channels are not to be trusted.",
            )
        new_frames = (*self._part, np.where(has_reading, voltages, np.nan))
        state = replace(
            self, time=time, frames=self.frames + 1, status=status, reason=reason, usable=usable, _part=new_frames
        )
        if len(new_frames) < healthy.stride:
            return state
        (averaged_frame,) = average_frames(np.array(new_frames), healthy.stride)
        first_frame = self.frames + 1 - healthy.stride
        recent_frames = (*self._window, (time, first_frame, averaged_frame))[-2 * healthy.window :]
        state = replace(state, _part=(), _window=recent_frames, _steps=self._steps + 1)
        return state._compare_windows() if state._steps % max(1, healthy.window // 4) == 0 else state

    def _compare_windows(self) -> "SkinHealth":
        """Return the state after comparing the medians of the last two windows of frames."""
        healthy, num_averages = self.healthy, len(self._window)
        if num_averages < healthy.window:
            return self
        frames = np.array([averaged_frame for _, _, averaged_frame in self._window])
        medians = channel_medians(frames[-healthy.window :])
        if not self._settled:
            return self._process_first_window(medians)
        next_state = self._update_pending(medians)
        if num_averages == 2 * healthy.window:
            # Changes in untrusted channels belong to known events and are ignored.
            sudden_change = lasting_step(frames, np.where(next_state.trusted, healthy.scale, np.inf), healthy.limit)
            if sudden_change is not None:
                return next_state._process_step(sudden_change, frames)
            next_state = next_state._check_channels(frames)
        reference_change = np.where(self.trusted & np.isfinite(medians), medians - self.reference, 0.0)
        if next_state._pending is None and change_size(reference_change / healthy.scale) < healthy.limit:
            updated_reference = self.reference + _REFERENCE_WEIGHT * (medians - self.reference)
            next_state = next_state._with_reference(np.where(np.isfinite(medians), updated_reference, self.reference))
        return next_state

    def _process_first_window(self, medians: np.ndarray) -> "SkinHealth":
        """Return the state after comparing the first window of frames with the healthy frames."""
        healthy = self.healthy
        change = np.where(np.isfinite(medians), medians - healthy.reference, 0.0)
        # A uniform drift of conductivity, which scales all channels alike, is removed if it is small.
        uniform_change = np.where(healthy.used, healthy.reference / healthy.level_scale, 0.0)
        scaled_change = np.where(healthy.used, change / healthy.level_scale, 0.0)
        if uniform_change @ uniform_change > 0 and abs(scaled_change @ uniform_change) < 0.1 * (
            uniform_change @ uniform_change
        ):
            scaled_change = scaled_change - uniform_change * (scaled_change @ uniform_change) / (
                uniform_change @ uniform_change
            )
        size_of_change = float(change_size(scaled_change))
        first_deviations = np.array([averaged for _, _, averaged in self._window]) - healthy.reference
        change_direction = change / healthy.level_scale**2
        frame_projections = (
            np.nan_to_num(first_deviations / healthy.level_scale**2) @ change / max(change_direction @ change, 1e-300)
        )
        state = replace(self, _settled=True)._with_reference(np.where(np.isfinite(medians), medians, self.reference))
        if size_of_change <= healthy.level_limit or not is_distinct(frame_projections, 0):
            return state
        time, frame, _ = self._window[0]
        change = LastingChange(change, size_of_change / healthy.level_limit * healthy.limit, time, frame, self.time)
        frames = np.array([averaged for _, _, averaged in self._window])
        findings = classify_change(change.vector, frames, healthy.reference, healthy, self.record.touching, self.skin)
        findings = [
            finding
            if finding.channels is not None
            else replace(finding, reason=f"{finding.reason} {_FIRST_WINDOW_NOTE}")
            for finding in findings
        ]
        return state._with_reference(healthy.reference)._add_events(change, findings)

    def _update_pending(self, medians: np.ndarray) -> "SkinHealth":
        """Return the state after checking whether the pending change has disappeared or outlasted a touch."""
        pending = self._pending
        if pending is None:
            return self
        change, scale = np.nan_to_num(pending.change.vector), np.where(self.trusted, self.healthy.scale, np.inf)
        remaining_change = np.where(np.isfinite(medians), medians - self.reference, 0.0)
        remaining_fraction = (remaining_change / scale**2) @ change / max((change / scale**2) @ change, 1e-300)
        if remaining_fraction < 1 - MIN_DISAPPEARED_FRACTION:
            return replace(self, _pending=None)
        if self.time - pending.change.time < self.patience:
            return self
        lasting_change = replace(
            pending.change, vector=np.where(self.trusted, remaining_change, 0.0), detection_time=self.time
        )
        reason = f"{pending.finding.reason} It has lasted for {self.time - pending.change.time:.3g} s or frames."
        return replace(self, _pending=None)._add_events(lasting_change, [replace(pending.finding, reason=reason)])

    def _process_step(self, step: Step, frames: np.ndarray) -> "SkinHealth":
        """Return the state after a lasting step of the voltages was found."""
        time, frame, _ = self._window[step.first_frame]
        change = LastingChange(step.change, step.size, time, frame, self.time)
        next_state = replace(self, _window=self._window[step.first_frame :])
        frames_after = frames[step.first_frame :]
        reference_change = np.where(np.isfinite(step.change), channel_medians(frames_after) - self.reference, 0.0)
        usual_change = np.where(self.trusted, self.healthy.scale, np.inf)
        if change_size(reference_change / usual_change) <= self.healthy.limit:  # the skin is as before a touch
            return next_state
        record_without_reversed_event = self.record.mend_reversed_event(change)
        if record_without_reversed_event is not None:
            return replace(next_state, record=record_without_reversed_event)
        findings = classify_change(
            step.change, frames_after, self.reference, self.healthy, self.record.touching, self.skin
        )
        if findings[0].electrode is not None or (findings[0].is_certain and change.size > self.healthy.sudden_limit):
            return next_state._add_events(change, findings)
        if self._pending is not None:  # only one change is pending at a time: the first
            return next_state
        return replace(next_state, _pending=_PendingChange(change, findings[0]))

    def _check_channels(self, frames: np.ndarray) -> "SkinHealth":
        """Return the state after checking for single channels that are noisy or stuck."""
        steadiness, checked_channels = self.healthy.steadiness, self.trusted.copy()
        for event in self.events:
            if event.kind in CHANNEL_KINDS and event.status == EventStatus.DENIED:
                checked_channels &= ~event.channels
        time, frame, _ = self._window[0]
        event_time = LastingChange(np.zeros(self.reference.size), self.healthy.limit, time, frame, self.time)
        noisy_channels = steadiness.noisy_channels(frames, checked_channels)
        stuck_channels = steadiness.stuck_channels(frames, checked_channels)
        updated_record = self.record.add_channel_faults(EventKind.NOISY, noisy_channels, event_time)
        return replace(self, record=updated_record.add_channel_faults(EventKind.STUCK, stuck_channels, event_time))

    def _with_reference(self, reference: Float[np.ndarray, " M"]) -> "SkinHealth":
        return replace(self, record=replace(self.record, reference=reference))

    def _add_events(self, change: LastingChange, findings: list[Finding]) -> "SkinHealth":
        return replace(self, record=self.record.add_events(change, findings, EventStatus.LASTING))


def watch(health: SkinHealth, frames: ArrayLike, times: ArrayLike | None = None) -> SkinHealth:
    """Process a recording of a monitored skin frame by frame, and return the state of the skin after the last frame.

    **Arguments:**

    - `health`: state of the monitored skin before the recording.
    - `frames`: frames (frames, channels), volts.
    - `times`: times of the frames, seconds; by default, frames are counted.

    Raises `ValueError` as `SkinHealth.follow` does, and if the number of times is not that of frames.

    **Example:**

    ```python
    for event in watch(health, damaged).events:
        print(event.kind, event.frame, event.strength)
    ```
    """
    check_kind("health", health, SkinHealth, "a SkinHealth, as of SkinHealth.fit(healthy)")
    checked_frames = real_array("frames", frames, "(F, M) volts")
    if checked_frames.ndim != 2:
        raise ValueError(f"frames must be (F, M) volts; they have shape {checked_frames.shape}.")
    if times is None:
        first_time = health.time + 1 if np.isfinite(health.time) else 0.0
        seconds = first_time + np.arange(len(checked_frames))
    else:
        seconds = check_times(times, len(checked_frames))
    for time, frame in zip(seconds, checked_frames, strict=True):
        health = health.follow(float(time), frame)
    return health
