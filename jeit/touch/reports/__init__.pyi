from .gestures import report_gestures, write_gestures
from .image_network import report_learnt_images, write_depths, write_learnt_images
from .learnt_skin import report_learnt_skin, write_learnt_skin, write_touches
from .listener import draw_heard, report_heard, report_listener, write_heard, write_listener
from .skin_health import draw_health, report_health, write_health
from .touch_watch import draw_watch, report_watch, write_watch

__all__ = [
    "draw_health",
    "draw_heard",
    "draw_watch",
    "report_gestures",
    "report_health",
    "report_heard",
    "report_learnt_images",
    "report_learnt_skin",
    "report_listener",
    "report_watch",
    "write_depths",
    "write_gestures",
    "write_health",
    "write_heard",
    "write_learnt_images",
    "write_learnt_skin",
    "write_listener",
    "write_touches",
    "write_watch",
]
