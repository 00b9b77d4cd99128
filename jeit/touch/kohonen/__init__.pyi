from .placed_map import PlacedMap, drawn_map, read_map, write_map
from .self_organising_map import MapQuality, SelfOrganisingMap, fit_maps, learning_curves, map_quality, time_constant
from .simultaneous_touches import MapTouch, neuron_shares, touches_reported
from .training import MapSchedule

__all__ = [
    "MapQuality",
    "MapSchedule",
    "MapTouch",
    "PlacedMap",
    "SelfOrganisingMap",
    "drawn_map",
    "fit_maps",
    "learning_curves",
    "map_quality",
    "neuron_shares",
    "read_map",
    "time_constant",
    "touches_reported",
    "write_map",
]
