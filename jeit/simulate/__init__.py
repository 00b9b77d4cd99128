"""Simulated skins and touches, where nothing is measured: skins that are pressed, skins that sound, and the
touches on them.

The physics of pressing is in `jeit.simulate.contact`; what a sounding skin is made of (its layer, microphones and
readout), in `jeit.simulate.acoustic`; how people touch, in `jeit.simulate.people` and `jeit.simulate.acoustic.people`.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.simulate.acoustic.bursts import Burst
from jeit.simulate.acoustic.calibration_taps import calibration_taps
from jeit.simulate.acoustic.microphones import microphone_grid
from jeit.simulate.acoustic.people import SoundClip, SoundingPerson, sound_clips
from jeit.simulate.acoustic.sound import quiet
from jeit.simulate.acoustic.sounding_skin import SoundingSkin
from jeit.simulate.acoustic.touches import pat, stroke, tap, tickle
from jeit.simulate.acoustic.wind import room_sound, wind
from jeit.simulate.contact import (
    Bar,
    DepthMap,
    Disc,
    Foundation,
    HalfSpace,
    Indent,
    IndentDraws,
    IndentSet,
    Joined,
    Material,
    MovingPress,
    Placed,
    Press,
    PressDraws,
    PressedSkin,
    PressSet,
    Prism,
    Revolved,
    Ring,
    TwoSheets,
    ball,
    depth_maps,
    indented_cells,
    material,
    open_presses,
    relative_changes,
    simulate_presses,
)
from jeit.simulate.people import GestureStream, Person, simulate_gesture_stream, simulate_gestures
from jeit.simulate.round_skin import RoundSkin, simulate_press

_tell_old_names(__name__)

__all__ = [
    "Bar",
    "Burst",
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
    "RoundSkin",
    "SoundClip",
    "SoundingPerson",
    "SoundingSkin",
    "TwoSheets",
    "ball",
    "calibration_taps",
    "depth_maps",
    "indented_cells",
    "material",
    "microphone_grid",
    "open_presses",
    "pat",
    "quiet",
    "relative_changes",
    "room_sound",
    "simulate_gesture_stream",
    "simulate_gestures",
    "simulate_press",
    "simulate_presses",
    "sound_clips",
    "stroke",
    "tap",
    "tickle",
    "wind",
]
