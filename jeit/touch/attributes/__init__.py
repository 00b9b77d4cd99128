"""How finely a skin feels: the five attributes of touch of Silvera Tawil et al. 2011, section IV-A.

Each is measured from what was recorded on a skin; `touch_attributes` asks for all the touches that it needs, of a robot
or of a simulated skin, and measures them all.
"""

from __future__ import annotations

from jeit.touch.attributes.measures import (
    ContactArea,
    Localisation,
    contact_area,
    least_told,
    point_localisation,
    response_times,
    weber_ratio,
)
from jeit.touch.attributes.trials import DiscTouch, TouchAttributes, touch_attributes

__all__ = [
    "ContactArea",
    "DiscTouch",
    "Localisation",
    "TouchAttributes",
    "contact_area",
    "least_told",
    "point_localisation",
    "response_times",
    "touch_attributes",
    "weber_ratio",
]
