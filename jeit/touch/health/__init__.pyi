from .event import EventKind, EventStatus, HealthEvent
from .skin_health import SkinHealth, WatchStatus, watch

__all__ = [
    "EventKind",
    "EventStatus",
    "HealthEvent",
    "SkinHealth",
    "WatchStatus",
    "watch",
]
