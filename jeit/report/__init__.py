"""What is told of results, and all that is written to a folder: measurements, images, streams, compared rules,
calibrations of microphones, tracks, layouts, studies, learnt skins, gestures, watched skins, networks that image."""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.report.calibration import draw_calibration, write_calibration
from jeit.report.compared_rules import draw_choice, report_choice, write_choice
from jeit.report.film import write_film
from jeit.report.gestures import report_gestures, write_gestures
from jeit.report.image import draw_image, report_image, write_image
from jeit.report.image_network import report_learnt_images, write_depths, write_learnt_images
from jeit.report.layout_comparison import draw_layout_comparison, report_layout_comparison, write_layout_comparison
from jeit.report.layout_improvement import draw_improved_layout, report_improved_layout, write_improved_layout
from jeit.report.learnt_skin import report_learnt_skin, write_learnt_skin, write_touches
from jeit.report.listener import draw_heard, report_heard, report_listener, write_heard, write_listener
from jeit.report.measurement import report_measurement
from jeit.report.saved_image import SavedImage, read_image
from jeit.report.saved_image_views import write_views
from jeit.report.series import write_series
from jeit.report.skin_health import draw_health, report_health, write_health
from jeit.report.stream import write_stream
from jeit.report.study import write_study_report
from jeit.report.touch_watch import draw_watch, report_watch, write_watch
from jeit.report.track import draw_track, report_track, write_track
from jeit.report.volume_files import write_vtk_series, write_vtu, write_xdmf

_tell_old_names(__name__)

__all__ = [
    "SavedImage",
    "draw_calibration",
    "draw_choice",
    "draw_health",
    "draw_heard",
    "draw_image",
    "draw_improved_layout",
    "draw_layout_comparison",
    "draw_track",
    "draw_watch",
    "read_image",
    "report_choice",
    "report_gestures",
    "report_health",
    "report_heard",
    "report_image",
    "report_improved_layout",
    "report_layout_comparison",
    "report_learnt_images",
    "report_learnt_skin",
    "report_listener",
    "report_measurement",
    "report_track",
    "report_watch",
    "write_calibration",
    "write_choice",
    "write_depths",
    "write_film",
    "write_gestures",
    "write_health",
    "write_heard",
    "write_image",
    "write_improved_layout",
    "write_layout_comparison",
    "write_learnt_images",
    "write_learnt_skin",
    "write_listener",
    "write_series",
    "write_stream",
    "write_study_report",
    "write_touches",
    "write_track",
    "write_views",
    "write_vtk_series",
    "write_vtu",
    "write_watch",
    "write_xdmf",
]
