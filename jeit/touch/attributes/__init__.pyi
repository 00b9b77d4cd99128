from .measures import (
    ContactArea,
    Localisation,
    contact_area,
    least_detected,
    point_localisation,
    response_times,
    weber_ratio,
)
from .trials import DiscTouch, TouchAttributes, touch_attributes

__all__ = [
    "ContactArea",
    "DiscTouch",
    "Localisation",
    "TouchAttributes",
    "contact_area",
    "least_detected",
    "point_localisation",
    "response_times",
    "touch_attributes",
    "weber_ratio",
]
