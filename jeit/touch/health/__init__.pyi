from .event import EventKind, EventStatus, HealthEvent, WatchStatus
from .skin_health import SkinHealth, watch

__all__ = [
    "EventKind",
    "EventStatus",
    "HealthEvent",
    "SkinHealth",
    "WatchStatus",
    "watch",
]
