"""`HealthRecord`: what is known about a monitored skin: its reference voltages, trusted channels, events and cuts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jeit.arguments import check_kind
from jeit.touch.health.event import EventKind, EventStatus, HealthEvent, change_size
from jeit.touch.health.finding import Finding, ImagedSkin, LastingChange
from jeit.touch.health.healthy import HealthyState

# Fraction of a change that must have disappeared for the change to count as gone, and maximum norm of what is left of
# a change that another reverses, relative to the change.
MIN_DISAPPEARED_FRACTION, _MAX_REMAINING_FRACTION = 0.6, 0.6
# Kinds of events that concern single channels.
CHANNEL_KINDS = (EventKind.NOISY, EventKind.STUCK)


@dataclass(frozen=True)
class HealthRecord:
    """What is known about a monitored skin. Its methods return a new record.

    **Fields**: `healthy`: healthy state; `reference`: present voltages of the untouched skin, volts; `trusted`: whether
    each channel has readings and no open event excludes it; `skin`: model of the skin with its cuts, or None;
    `touching` (electrodes, channels): whether each channel uses each electrode, or None; `events`: events so far.
    """

    healthy: HealthyState
    reference: Float[np.ndarray, " M"]
    trusted: Bool[np.ndarray, " M"]
    skin: ImagedSkin | None = None
    touching: Bool[np.ndarray, "L M"] | None = None
    events: tuple[HealthEvent, ...] = ()

    @property
    def open_events(self) -> list[HealthEvent]:
        """The events that still apply: neither denied nor mended, and no repairs."""
        return [event for event in self.events if event.open]

    def create_event(
        self, change: LastingChange, finding: Finding, status: EventStatus, number: int | None = None
    ) -> HealthEvent:
        """Create an event from a change and its cause. `number`: default: the number of the next event."""
        is_affected_channel = np.ones(self.reference.size, bool) if finding.channels is None else finding.channels
        is_large_change = np.abs(np.nan_to_num(change.vector)) > self.healthy.limit * self.healthy.scale
        return HealthEvent(
            number=len(self.events) if number is None else number,
            kind=finding.kind,
            status=status,
            time=change.time,
            noticed=change.detection_time,
            frame=change.frame,
            channels=is_large_change & is_affected_channel,
            change=np.where(is_affected_channel, change.vector, 0.0),
            strength=change.size / self.healthy.limit,
            electrode=finding.electrode,
            path=None if finding.loss is None else finding.loss.path,
            deviation=0.0 if finding.loss is None else finding.loss.deviation,
            through=None if finding.loss is None else finding.loss.through,
            reason=finding.reason,
        )

    def add_events(self, change: LastingChange, findings: list[Finding], status: EventStatus) -> HealthRecord:
        """Add an event for each finding, and their change to the reference voltages."""
        new_events = [
            self.create_event(change, finding, status, len(self.events) + finding_index)
            for finding_index, finding in enumerate(findings)
        ]
        # If electrodes fail, the reference changes only in their channels, since the skin may be touched meanwhile.
        is_affected_channel = np.logical_or.reduce(
            [np.ones_like(self.trusted) if finding.channels is None else finding.channels for finding in findings]
        )
        skin_with_cuts = self.skin
        for finding in findings:
            if finding.loss is not None and skin_with_cuts is not None:
                skin_with_cuts = skin_with_cuts.with_cut(finding.loss)
        new_reference = np.where(
            is_affected_channel & np.isfinite(change.vector), self.reference + change.vector, self.reference
        )
        return replace(
            self, events=(*self.events, *new_events), reference=new_reference, skin=skin_with_cuts
        )._update_trusted_channels()

    def add_channel_faults(
        self, kind: EventKind, channels: Bool[np.ndarray, " M"], event_time: LastingChange
    ) -> HealthRecord:
        """Add an event for each of the noisy or stuck `channels` (M,). `event_time`: the time of the events; its change
        is not used."""
        fault_description = (
            "is several times as noisy as it was, or jumps" if kind == EventKind.NOISY else "does not move"
        )
        updated_record = self
        for channel in np.flatnonzero(channels):
            is_faulty_channel = np.arange(self.reference.size) == channel
            finding = Finding(kind, f"Channel {channel} {fault_description}.", True, channels=is_faulty_channel)
            channel_event = updated_record.create_event(event_time, finding, EventStatus.LASTING)
            channel_event = eqx.tree_at(lambda channel_event: channel_event.channels, channel_event, is_faulty_channel)
            updated_record = replace(updated_record, events=(*updated_record.events, channel_event))
        return updated_record if updated_record is self else updated_record._update_trusted_channels()

    def set_event_status(self, event: HealthEvent, status: EventStatus) -> HealthRecord:
        """Set the status of an event. Raises `ValueError` for an event of a different skin."""
        check_kind("event", event, HealthEvent, "one of health.events, or health.held")
        if not event.number < len(self.events):
            raise ValueError(f"event {event.number} does not belong to this skin, which has {len(self.events)} events.")
        events = [
            _set_status(known_event, status) if known_event.number == event.number else known_event
            for known_event in self.events
        ]
        return replace(self, events=tuple(events))

    def deny_event(self, event: HealthEvent) -> HealthRecord:
        """Deny an event, and reset the reference voltages to those before it. Raises `ValueError` for an event of a
        different skin."""
        restored_reference = np.where(np.isfinite(event.change), self.reference - event.change, self.reference)
        return replace(
            self.set_event_status(event, EventStatus.DENIED), reference=restored_reference
        )._update_trusted_channels()

    def mend_reversed_event(self, change: LastingChange) -> HealthRecord | None:
        """Mend the event whose change is reversed by `change`; None if there is no such event."""
        for earlier_event in self.open_events:
            is_used_channel = np.isfinite(earlier_event.change) & np.isfinite(change.vector) & self.trusted
            earlier_change = (earlier_event.change[is_used_channel] / self.healthy.scale[is_used_channel]).clip(
                -1e9, 1e9
            )
            new_change = (change.vector[is_used_channel] / self.healthy.scale[is_used_channel]).clip(-1e9, 1e9)
            reversed_fraction = -(new_change @ earlier_change) / max(earlier_change @ earlier_change, 1e-300)
            remaining_change_norm = np.linalg.norm(new_change + earlier_change)
            if (
                reversed_fraction > MIN_DISAPPEARED_FRACTION
                and remaining_change_norm < _MAX_REMAINING_FRACTION * np.linalg.norm(earlier_change)
            ):
                mended_record = self.set_event_status(earlier_event, EventStatus.MENDED)
                repair_reason = f"Event {earlier_event.number} is gone: it was mended, or a press that has been lifted."
                finding = Finding(EventKind.REPAIRED, repair_reason, True)
                repair_event = mended_record.create_event(change, finding, EventStatus.LASTING)
                restored_reference = np.where(
                    np.isfinite(change.vector), self.reference + change.vector, self.reference
                )
                return replace(
                    mended_record, events=(*mended_record.events, repair_event), reference=restored_reference
                )._update_trusted_channels()
        return None

    def mend_all_events(self, reference: Float[np.ndarray, " M"], time: float, frame: int) -> HealthRecord:
        """Mend all open events after the user has repaired the skin. `reference`: voltages of the repaired skin, volts,
        NaN in channels without a reading."""
        has_reading = np.isfinite(reference) & self.healthy.used
        voltage_change = np.where(has_reading, reference - self.reference, 0.0)
        mended_events = [_set_status(event, EventStatus.MENDED) if event.open else event for event in self.events]
        event = HealthEvent(
            number=len(self.events),
            kind=EventKind.REPAIRED,
            status=EventStatus.CONFIRMED,
            time=time,
            noticed=time,
            frame=frame,
            channels=np.abs(voltage_change) > self.healthy.limit * self.healthy.scale,
            change=voltage_change,
            strength=float(change_size(voltage_change / self.healthy.scale)) / self.healthy.limit,
            reason="As the user says.",
        )
        return replace(
            self,
            events=(*mended_events, event),
            reference=np.where(has_reading, reference, self.reference),
            trusted=has_reading,
            skin=None if self.skin is None else self.skin.without_cuts(),
        )

    def _update_trusted_channels(self) -> HealthRecord:
        """Update the trusted channels and the cuts of the model after a change of the events."""
        trusted_channels = self.healthy.used.copy()
        for event in self.open_events:
            if event.electrode is not None and self.touching is not None:
                trusted_channels &= ~self.touching[event.electrode]
            if event.kind in CHANNEL_KINDS:
                trusted_channels &= ~event.channels
        has_cut = any(event.path is not None for event in self.open_events)
        present_skin = self.skin if self.skin is None or has_cut else self.skin.without_cuts()
        return replace(self, trusted=trusted_channels, skin=present_skin)


def _set_status(event: HealthEvent, status: EventStatus) -> HealthEvent:
    return eqx.tree_at(lambda event_to_change: event_to_change.status, event, status)
