from .contact.half_space import HalfSpace
from .contact.indent_sets import IndentSet
from .contact.indenters import Bar, DepthMap, Disc, Prism, Revolved, Ring, ball
from .contact.indents import Indent, IndentDraws, PressDraws, depth_maps, indented_cells, relative_changes
from .contact.joined import JoinedIndenters, PlacedIndenter, TwoSheets
from .contact.materials import Foundation, Material, material
from .contact.press import MovingPress, Press
from .contact.press_sets import PressSet, open_presses, simulate_presses
from .contact.pressed_skin import PressedSkin
from .people.person import Person
from .people.simulated_gestures import GestureStream, simulate_gesture_stream, simulate_gestures

__all__ = [
    "Bar",
    "DepthMap",
    "Disc",
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
    "simulate_gesture_stream",
    "simulate_gestures",
    "simulate_presses",
]
