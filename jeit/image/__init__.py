"""Images: rasters of what lives on a mesh, planes and surfaces through a solid, inclusions, and regions over time."""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.image.image_series import ImageSeries
from jeit.image.inclusions import Inclusion, find_inclusions
from jeit.image.isosurface import TriangleSurface, isosurface_of, node_values
from jeit.image.merit import figures_of_merit
from jeit.image.oscillations import Oscillation, amplitude_spectrum, oscillation
from jeit.image.plane import Plane, cut_by_plane
from jeit.image.raster import Raster
from jeit.image.regions import ball_region, box_region, half_region
from jeit.image.segmentation import segment
from jeit.image.solid_form import SolidForm

_tell_old_names(__name__)

__all__ = [
    "ImageSeries",
    "Inclusion",
    "Oscillation",
    "Plane",
    "Raster",
    "SolidForm",
    "TriangleSurface",
    "amplitude_spectrum",
    "ball_region",
    "box_region",
    "cut_by_plane",
    "figures_of_merit",
    "find_inclusions",
    "half_region",
    "isosurface_of",
    "node_values",
    "oscillation",
    "segment",
]
