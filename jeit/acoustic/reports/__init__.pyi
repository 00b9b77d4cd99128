from .calibration import draw_calibration, write_calibration
from .track import draw_track, report_track, write_track

__all__ = [
    "draw_calibration",
    "draw_track",
    "report_track",
    "write_calibration",
    "write_track",
]
