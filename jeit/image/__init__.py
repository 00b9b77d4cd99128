"""Images: rasters of what lives on a mesh, and the inclusions found in them."""

from jeit.image.inclusions import Inclusion, find_inclusions
from jeit.image.merit import figures_of_merit
from jeit.image.raster import Raster
from jeit.image.segmentation import segment

__all__ = [
    "Inclusion",
    "Raster",
    "figures_of_merit",
    "find_inclusions",
    "segment",
]
