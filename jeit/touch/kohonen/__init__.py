"""Kohonen's self-organising map: a skin's frames learnt without a model, and what the map then says of touches.

Rooms beside it: `jeit.touch.learnt` has it as a method, "som", of `jeit touch fit`.
"""

from __future__ import annotations

from jeit.touch.kohonen.drawing import drawn_map
from jeit.touch.kohonen.map_file import read_map, write_map
from jeit.touch.kohonen.placed_map import PlacedMap
from jeit.touch.kohonen.quality import MapQuality, map_quality
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap, fit_maps
from jeit.touch.kohonen.settling import learning_curves, time_constant
from jeit.touch.kohonen.several_touches import MapTouch, neuron_shares, touches_told
from jeit.touch.kohonen.training import Schedule

__all__ = [
    "MapQuality",
    "MapTouch",
    "PlacedMap",
    "Schedule",
    "SelfOrganisingMap",
    "drawn_map",
    "fit_maps",
    "learning_curves",
    "map_quality",
    "neuron_shares",
    "read_map",
    "time_constant",
    "touches_told",
    "write_map",
]
