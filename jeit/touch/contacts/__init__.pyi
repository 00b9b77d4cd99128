from .cell_finder import CellFinder
from .finder import Contact, ImageNoise, find_contacts
from .load_calibration import Load, LoadCalibration
from .raster_finder import RasterFinder, RasterStages
from .tracker import ContactTracker, TouchPath, track_contacts

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
