"""Images: rasters of what lives on a mesh, planes and surfaces through a solid, and the inclusions found in them."""

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.image.inclusions import Inclusion, find_inclusions
from jeit.image.isosurface import TriangleSurface, isosurface_of, node_values
from jeit.image.merit import figures_of_merit
from jeit.image.plane import Plane, cut_by_plane
from jeit.image.raster import Raster
from jeit.image.segmentation import segment

_tell_old_names(__name__)

__all__ = [
    "Inclusion",
    "Plane",
    "Raster",
    "TriangleSurface",
    "cut_by_plane",
    "figures_of_merit",
    "find_inclusions",
    "isosurface_of",
    "node_values",
    "segment",
]
