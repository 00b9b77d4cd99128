"""Images: rasters of what lives on a mesh, and the inclusions found in them."""

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.image.inclusions import Inclusion, find_inclusions
from jeit.image.merit import figures_of_merit
from jeit.image.raster import Raster
from jeit.image.segmentation import segment

_tell_old_names(__name__)

__all__ = [
    "Inclusion",
    "Raster",
    "figures_of_merit",
    "find_inclusions",
    "segment",
]
