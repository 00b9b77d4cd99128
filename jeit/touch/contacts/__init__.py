"""Contacts found in images of change, followed from frame to frame, and what load each carries."""

from __future__ import annotations

from jeit.touch.contacts.cell_finder import CellFinder
from jeit.touch.contacts.contact import Contact
from jeit.touch.contacts.finder import find_contacts
from jeit.touch.contacts.image_noise import ImageNoise
from jeit.touch.contacts.load_calibration import Load, LoadCalibration
from jeit.touch.contacts.raster_finder import RasterFinder, RasterStages
from jeit.touch.contacts.tracker import ContactTracker, TouchPath, track_contacts

__all__ = [
    "CellFinder",
    "Contact",
    "ContactTracker",
    "ImageNoise",
    "Load",
    "LoadCalibration",
    "RasterFinder",
    "RasterStages",
    "TouchPath",
    "find_contacts",
    "track_contacts",
]
