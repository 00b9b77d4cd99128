"""From frames to meaning: where, how hard and how a skin is touched.

Rooms: `contacts` (what an image shows, from frame to frame, in newtons), `learnt` (skins that learn from recorded
presses, without a model), `kohonen` (maps that order frames by themselves), `health` (cuts, electrodes that fail,
repair).
"""

from jeit.touch.contacts import (
    CellFinder,
    Contact,
    ContactTracker,
    ImageNoise,
    LoadCalibration,
    RasterFinder,
    find_contacts,
    track_contacts,
)
from jeit.touch.health import HealthEvent, SkinHealth, watch
from jeit.touch.kohonen import PlacedMap, SelfOrganisingMap
from jeit.touch.learnt.file import read_skin, write_skin
from jeit.touch.learnt.learnt_skin import LearntSkin, Standing
from jeit.touch.learnt.presses import Presses, read_frames, read_presses
from jeit.touch.learnt.touches import Touches

__all__ = [
    "CellFinder",
    "Contact",
    "ContactTracker",
    "HealthEvent",
    "ImageNoise",
    "LearntSkin",
    "LoadCalibration",
    "PlacedMap",
    "Presses",
    "RasterFinder",
    "SelfOrganisingMap",
    "SkinHealth",
    "Standing",
    "Touches",
    "find_contacts",
    "read_frames",
    "read_presses",
    "read_skin",
    "track_contacts",
    "watch",
    "write_skin",
]
