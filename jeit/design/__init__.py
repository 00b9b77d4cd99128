"""Where electrodes should go, before any material is cut.

What a skin of a given layout, its electrodes' positions, will feel: sensitivity maps, virtual taxels, scores. Better
layouts: moved by gradients, within an outline and with minimum spacing; and the measurements worth making with them.
Studies of many layouts, which survive a crash.
"""

from jeit.design.comparison import comparison as comparison
from jeit.design.measurements.candidates import Candidates as Candidates
from jeit.design.measurements.selection import Selection as Selection
from jeit.design.measurements.selection import farthest_pairs as farthest_pairs
from jeit.design.measurements.selection import information as information
from jeit.design.measurements.selection import information_bound as information_bound
from jeit.design.measurements.selection import nearest_pairs as nearest_pairs
from jeit.design.measurements.selection import random_selections as random_selections
from jeit.design.measurements.selection import select_measurements as select_measurements
from jeit.design.optimisation.constraints import Constraints as Constraints
from jeit.design.optimisation.optimise import Optimisation as Optimisation
from jeit.design.optimisation.optimise import balanced as balanced
from jeit.design.optimisation.optimise import optimise_layout as optimise_layout
from jeit.design.scores import Score as Score
from jeit.design.scores import Scores as Scores
from jeit.design.scores import TouchPrior as TouchPrior
from jeit.design.scores import layout_scores as layout_scores
from jeit.design.sensitivity import SensitivityMap as SensitivityMap
from jeit.design.sensitivity import sensitivity_map as sensitivity_map
from jeit.design.skin.indentation import AbstractIndentation as AbstractIndentation
from jeit.design.skin.indentation import Bell as Bell
from jeit.design.skin.indentation import Hemisphere as Hemisphere
from jeit.design.skin.sheet_touches import SheetTouches as SheetTouches
from jeit.design.skin.sheet_touches import sheet_touches as sheet_touches
from jeit.design.skin.touch_grid import TouchGrid as TouchGrid
from jeit.design.skin.touch_grid import touch_grid as touch_grid
from jeit.design.skin.touch_grid import touches_away_from_the_edge as touches_away_from_the_edge
from jeit.design.skin.touched_cells import TouchedCells as TouchedCells
from jeit.design.skin.touched_cells import touched_cells as touched_cells
from jeit.design.skin.voltage_changes import touch_changes as touch_changes
from jeit.design.skin_response import SkinResponse as SkinResponse
from jeit.design.skin_response import TouchedSkin as TouchedSkin
from jeit.design.skin_response import feel as feel
from jeit.design.study import Study as Study
from jeit.design.study import open_results as open_results
from jeit.design.study import read_study as read_study
from jeit.design.study import run_study as run_study
from jeit.design.study import study_progress as study_progress
from jeit.design.taxels import Taxels as Taxels
from jeit.design.taxels import find_taxels as find_taxels
