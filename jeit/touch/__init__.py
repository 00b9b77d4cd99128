"""From frames to meaning: where, how hard and how a skin is touched.

Rooms: `contacts` (what an image shows, from frame to frame, in newtons).
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

__all__ = [
    "CellFinder",
    "Contact",
    "ContactTracker",
    "ImageNoise",
    "LoadCalibration",
    "RasterFinder",
    "find_contacts",
    "track_contacts",
]
