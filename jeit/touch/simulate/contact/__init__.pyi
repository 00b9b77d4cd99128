from .half_space import HalfSpace
from .indent_sets import IndentSet
from .indenters import Bar, DepthMap, Disc, Prism, Revolved, Ring, ball
from .indents import Indent, IndentDraws, PressDraws, depth_maps, indented_cells, relative_changes
from .joined import JoinedIndenters, PlacedIndenter, TwoSheets
from .materials import Foundation, Material, material
from .press import MovingPress, Press
from .press_sets import PressSet, open_presses, simulate_presses
from .pressed_skin import PressedSkin

__all__ = [
    "Bar",
    "DepthMap",
    "Disc",
    "Foundation",
    "HalfSpace",
    "Indent",
    "IndentDraws",
    "IndentSet",
    "JoinedIndenters",
    "Material",
    "MovingPress",
    "PlacedIndenter",
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
