from .localisation_error import plot_error_curve, plot_position_errors
from .maps import MapMarks, plot_loss_map, plot_receptive_fields
from .track import plot_track

__all__ = [
    "MapMarks",
    "plot_error_curve",
    "plot_loss_map",
    "plot_position_errors",
    "plot_receptive_fields",
    "plot_track",
]
