from .responses import plot_sensitivity_histograms, plot_sensitivity_map, plot_taxel_areas, plot_taxels
from .travel import plot_travel
from .unrolled_skin import plot_unrolled

__all__ = [
    "plot_sensitivity_histograms",
    "plot_sensitivity_map",
    "plot_taxel_areas",
    "plot_taxels",
    "plot_travel",
    "plot_unrolled",
]
