from .contact.foundation import Foundation
from .contact.half_space import HalfSpace
from .contact.indent_sets import IndentSet
from .contact.indenters import Bar, DepthMap, Disc, Prism, Revolved, Ring, ball
from .contact.indents import Indent, IndentDraws, depth_maps, indented_cells, relative_changes
from .contact.joined import Joined, Placed
from .contact.materials import Material, material
from .contact.press import MovingPress, Press
from .contact.press_draws import PressDraws
from .contact.press_sets import PressSet, open_presses, simulate_presses
from .contact.pressed_skin import PressedSkin
from .contact.two_sheets import TwoSheets
from .people.gesture_stream import GestureStream, simulate_gesture_stream
from .people.person import Person
from .people.simulated_gestures import simulate_gestures

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
    "Joined",
    "Material",
    "MovingPress",
    "Person",
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
    "simulate_gesture_stream",
    "simulate_gestures",
    "simulate_presses",
]
