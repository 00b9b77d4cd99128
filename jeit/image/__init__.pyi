from .image_series import ImageSeries, Oscillation, amplitude_spectrum, oscillation
from .inclusions import Inclusion, SolidForm, find_inclusions
from .plane import Cut, Plane, TriangleSurface, cut_by_plane, isosurface_of, node_values
from .rasters import FiguresOfMerit, Raster, figures_of_merit
from .segmentation import ball_region, box_region, half_region, segment

__all__ = [
    "Cut",
    "FiguresOfMerit",
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
