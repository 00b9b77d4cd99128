from .combined_skins import JoinedIndenters, PlacedIndenter, TwoSheets
from .half_space import HalfSpace
from .indent_sets import IndentSet
from .indenters import (
    BarIndenter,
    DepthMapIndenter,
    DiscIndenter,
    PrismIndenter,
    RevolvedIndenter,
    RingIndenter,
    ball_indenter,
)
from .indents import Indent, IndentDraws, PressDraws, depth_maps, indented_cells, relative_changes
from .materials import Foundation, Material, material
from .press import MovingPress, Press
from .press_sets import PressSet, open_presses, simulate_presses
from .pressed_skin import PressedSkin

__all__ = [
    "BarIndenter",
    "DepthMapIndenter",
    "DiscIndenter",
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
    "PrismIndenter",
    "RevolvedIndenter",
    "RingIndenter",
    "TwoSheets",
    "ball_indenter",
    "depth_maps",
    "indented_cells",
    "material",
    "open_presses",
    "relative_changes",
    "simulate_presses",
]
