from .image_network import report_learnt_images, write_depths, write_learnt_images
from .learnt_skin import report_learnt_skin, write_learnt_skin, write_touches
from .listener import draw_sound_labels, report_listener, report_sound_labels, write_listener, write_sound_labels
from .skin_health import draw_health, report_health, write_health
from .touch_watch import draw_watch, report_gestures, report_watch, write_gestures, write_watch

__all__ = [
    "draw_health",
    "draw_sound_labels",
    "draw_watch",
    "report_gestures",
    "report_health",
    "report_learnt_images",
    "report_learnt_skin",
    "report_listener",
    "report_sound_labels",
    "report_watch",
    "write_depths",
    "write_gestures",
    "write_health",
    "write_learnt_images",
    "write_learnt_skin",
    "write_listener",
    "write_sound_labels",
    "write_touches",
    "write_watch",
]
