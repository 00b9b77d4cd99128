"""Where electrodes should go, before any material is cut.

What a skin of a given layout, its electrodes' positions, will feel: sensitivity maps, virtual taxels, scores. Better
layouts: moved by gradients, within an outline and with minimum spacing; and the measurements worth making with them.
Studies of many layouts, which survive a crash.
"""

from jeit.design.candidates import Candidates as Candidates
from jeit.design.changes import touch_changes as touch_changes
from jeit.design.indentation import AbstractIndentation as AbstractIndentation
from jeit.design.indentation import Bell as Bell
from jeit.design.indentation import Hemisphere as Hemisphere
from jeit.design.press import Presses as Presses
from jeit.design.press import press as press
from jeit.design.selection import Selection as Selection
from jeit.design.selection import farthest_pairs as farthest_pairs
from jeit.design.selection import information as information
from jeit.design.selection import information_bound as information_bound
from jeit.design.selection import nearest_pairs as nearest_pairs
from jeit.design.selection import random_selections as random_selections
from jeit.design.selection import select_measurements as select_measurements
from jeit.design.sensitivity import SensitivityMap as SensitivityMap
from jeit.design.sensitivity import TouchGrid as TouchGrid
from jeit.design.sensitivity import sensitivity_map as sensitivity_map
from jeit.design.sensitivity import touch_grid as touch_grid
from jeit.design.taxels import Taxels as Taxels
from jeit.design.taxels import find_taxels as find_taxels
