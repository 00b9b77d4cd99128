"""The physics of contact: load → pressure → change of conductivity, in time → voltages.

An indenter says how far its surface is above its lowest point, and a support how pressure spreads beneath it.
Arrays are NumPy's: what touches what is no smooth function of anything.
"""

from __future__ import annotations

from jeit.simulate.contact.foundation import Foundation
from jeit.simulate.contact.half_space import HalfSpace
from jeit.simulate.contact.indent_sets import IndentSet
from jeit.simulate.contact.indenters import Bar, DepthMap, Disc, Prism, Revolved, Ring, ball
from jeit.simulate.contact.indents import Indent, IndentDraws, depth_maps, indented_cells, relative_changes
from jeit.simulate.contact.joined import Joined, Placed
from jeit.simulate.contact.materials import Material, material
from jeit.simulate.contact.press import MovingPress, Press
from jeit.simulate.contact.press_draws import PressDraws
from jeit.simulate.contact.press_sets import PressSet, open_presses, simulate_presses
from jeit.simulate.contact.pressed_skin import PressedSkin
from jeit.simulate.contact.two_sheets import TwoSheets

__all__ = [
    "Bar",
    "DepthMap",
    "Disc",
    "Foundation",
    "HalfSpace",
    "Indent",
    "IndentDraws",
    "IndentSet",
    "Joined",
    "Material",
    "MovingPress",
    "Placed",
    "Press",
    "PressDraws",
    "PressSet",
    "PressedSkin",
    "Prism",
    "Revolved",
    "Ring",
    "TwoSheets",
    "ball",
    "depth_maps",
    "indented_cells",
    "material",
    "open_presses",
    "relative_changes",
    "simulate_presses",
]
