"""Images: rasters of what lives on a mesh, and the inclusions found in them."""

from jeit.image.figures_of_merit import figures_of_merit as figures_of_merit
from jeit.image.inclusions import Inclusion as Inclusion
from jeit.image.inclusions import find_inclusions as find_inclusions
from jeit.image.raster import Raster as Raster
from jeit.image.segment import labelled_inclusions as labelled_inclusions
from jeit.image.segment import segment as segment
