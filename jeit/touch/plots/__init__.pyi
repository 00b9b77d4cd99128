from .contacts import plot_contact_stages, plot_contacts
from .health import plot_health, plot_health_course
from .kohonen_map import plot_map
from .learnt import (
    plot_answers,
    plot_confusion,
    plot_depth_map,
    plot_force_errors,
    plot_key_errors,
    plot_losses,
    plot_place_errors,
    plot_places,
    plot_tried,
)
from .timeline import plot_changes, plot_sound_labels, plot_timeline, plot_touch_paths

__all__ = [
    "plot_answers",
    "plot_changes",
    "plot_confusion",
    "plot_contact_stages",
    "plot_contacts",
    "plot_depth_map",
    "plot_force_errors",
    "plot_health",
    "plot_health_course",
    "plot_key_errors",
    "plot_losses",
    "plot_map",
    "plot_place_errors",
    "plot_places",
    "plot_sound_labels",
    "plot_timeline",
    "plot_touch_paths",
    "plot_tried",
]
