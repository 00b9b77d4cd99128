"""Electrodes: position, size, contact impedance, and their contact integrals.

| where | complete electrodes | point electrodes |
|---|---|---|
| edge of a sheet (2-D) | `BoundaryElectrodes` | `PointElectrodes` |
| inside a sheet (2-D) | `SheetDiscs` | `PointElectrodes` |
| inside a curved sheet | `SurfaceDiscs` | `PointElectrodes` |
| faces of a 3-D body | `FaceDiscs`, `FacePatches` | `PointElectrodes` |
| whole facets of a mesh, nodes of a mesh | `FacetElectrodes`, `plates`, `electrodes_from_nodes` | `NodeElectrodes` |
| several of these at once | `CombinedElectrodes` | |

Where to put them: `jeit.layout`.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.electrodes.boundary import BoundaryElectrodes
from jeit.electrodes.combined import CombinedElectrodes
from jeit.electrodes.discs import FaceDiscs, SheetDiscs
from jeit.electrodes.electrode_shapes import ElectrodeShapes, shapes_of
from jeit.electrodes.electrodes import AbstractElectrodes
from jeit.electrodes.facets import FacetElectrodes, electrodes_from_nodes, plates
from jeit.electrodes.patches import FacePatches
from jeit.electrodes.point import NodeElectrodes, PointElectrodes
from jeit.electrodes.surface_discs import SurfaceDiscs

_tell_old_names(__name__)

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
