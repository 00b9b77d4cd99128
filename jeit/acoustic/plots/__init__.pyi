from .localisation_error import plot_error_curve, plot_pairs
from .maps import Marks, plot_loss_map, plot_receptive_fields
from .track import plot_track

__all__ = [
    "Marks",
    "plot_error_curve",
    "plot_loss_map",
    "plot_pairs",
    "plot_receptive_fields",
    "plot_track",
]
