from .boundary import BoundaryElectrodes
from .discs import FaceDiscs, SheetDiscs, SurfaceDiscs
from .electrode_shapes import CombinedElectrodes, ElectrodeShapes, shapes_of
from .electrodes import AbstractElectrodes
from .face_patches import FacePatches, body_mesh
from .facets import FacetElectrodes, electrodes_from_nodes, plates
from .point import NodeElectrodes, PointElectrodes

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
    "body_mesh",
    "electrodes_from_nodes",
    "plates",
    "shapes_of",
]
