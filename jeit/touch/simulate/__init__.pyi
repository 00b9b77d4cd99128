from .contact.combined_skins import JoinedIndenters, PlacedIndenter, TwoSheets
from .contact.half_space import HalfSpace
from .contact.indent_sets import IndentSet
from .contact.indenters import (
    BarIndenter,
    DepthMapIndenter,
    DiscIndenter,
    PrismIndenter,
    RevolvedIndenter,
    RingIndenter,
    ball_indenter,
)
from .contact.indents import Indent, IndentDraws, PressDraws, depth_maps, indented_cells, relative_changes
from .contact.materials import Foundation, Material, material
from .contact.press import MovingPress, Press
from .contact.press_sets import PressSet, open_presses, simulate_presses
from .contact.pressed_skin import PressedSkin
from .people.person import Person
from .people.simulated_gestures import GestureStream, simulate_gesture_stream, simulate_gestures

__all__ = [
    "BarIndenter",
    "DepthMapIndenter",
    "DiscIndenter",
    "Foundation",
    "GestureStream",
    "HalfSpace",
    "Indent",
    "IndentDraws",
    "IndentSet",
    "JoinedIndenters",
    "Material",
    "MovingPress",
    "Person",
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
    "simulate_gesture_stream",
    "simulate_gestures",
    "simulate_presses",
]
