from .boundary import BoundaryElectrodes
from .combined import CombinedElectrodes
from .discs import FaceDiscs, SheetDiscs
from .electrode_shapes import ElectrodeShapes, shapes_of
from .electrodes import AbstractElectrodes
from .facets import FacetElectrodes, electrodes_from_nodes, plates
from .patches import FacePatches
from .point import NodeElectrodes, PointElectrodes
from .surface_discs import SurfaceDiscs

__all__ = [
    "AbstractElectrodes",
    "BoundaryElectrodes",
    "CombinedElectrodes",
    "ElectrodeShapes",
    "FaceDiscs",
    "FacePatches",
    "FacetElectrodes",
    "NodeElectrodes",
    "PointElectrodes",
    "SheetDiscs",
    "SurfaceDiscs",
    "electrodes_from_nodes",
    "plates",
    "shapes_of",
]
