from .cell_finder import CellFinder
from .finder import Contact, ImageNoise, find_contacts
from .load_calibration import LoadCalibration, LoadEstimate
from .raster_finder import RasterFinder, RasterStages
from .tracker import ContactTracker, TouchPath, track_contacts

__all__ = [
    "CellFinder",
    "Contact",
    "ContactTracker",
    "ImageNoise",
    "LoadCalibration",
    "LoadEstimate",
    "RasterFinder",
    "RasterStages",
    "TouchPath",
    "find_contacts",
    "track_contacts",
]
