from .comparison import compare_layouts, skin_response
from .improvement import improve_layout
from .measurements import Candidates, information_bound, select_measurements
from .optimisation.design_space import DesignSpace
from .optimisation.optimise import optimise_layout
from .optimisation.surface_optimise import optimise_surface_layout
from .optimisation.variables import Objective
from .plots import (
    plot_sensitivity_histograms,
    plot_sensitivity_map,
    plot_taxel_areas,
    plot_taxels,
    plot_travel,
    plot_unrolled,
)
from .reports import write_improved_layout, write_layout_comparison, write_study_report
from .scores import TouchPrior, layout_scores
from .sensitivity import sensitivity_map
from .skin.skin import Skin
from .skin.skin_file import describes_skin, read_described_skin
from .skin.touch_shapes import Bell, Hemisphere, touch_grid, touches_away_from_the_edge
from .study import open_results, read_study, run_study, study_progress
from .taxels import find_taxels

__all__ = [
    "Bell",
    "Candidates",
    "DesignSpace",
    "Hemisphere",
    "Objective",
    "Skin",
    "TouchPrior",
    "compare_layouts",
    "describes_skin",
    "find_taxels",
    "improve_layout",
    "information_bound",
    "layout_scores",
    "open_results",
    "optimise_layout",
    "optimise_surface_layout",
    "plot_sensitivity_histograms",
    "plot_sensitivity_map",
    "plot_taxel_areas",
    "plot_taxels",
    "plot_travel",
    "plot_unrolled",
    "read_described_skin",
    "read_study",
    "run_study",
    "select_measurements",
    "sensitivity_map",
    "skin_response",
    "study_progress",
    "touch_grid",
    "touches_away_from_the_edge",
    "write_improved_layout",
    "write_layout_comparison",
    "write_study_report",
]
