"""Whether a skin is still what it was: cuts, electrodes that fail, and repair, told from frames, and with a model."""

from __future__ import annotations

from jeit.touch.health.event import EventKind, EventStatus, HealthEvent
from jeit.touch.health.skin_health import SkinHealth, WatchStatus, watch

__all__ = ["EventKind", "EventStatus", "HealthEvent", "SkinHealth", "WatchStatus", "watch"]
