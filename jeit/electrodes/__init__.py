"""Electrodes: position, size, contact impedance, and their contact integrals.

| where | complete electrodes | point electrodes |
|---|---|---|
| edge of a sheet (2-D) | `BoundaryElectrodes` | `PointElectrodes` |
| inside a sheet (2-D) | `SheetDiscs` | `PointElectrodes` |
| faces of a 3-D body | `FaceDiscs`, `FacePatches` | `PointElectrodes` |
| whole facets of a mesh, nodes of a mesh | `FacetElectrodes`, `plates`, `electrodes_from_nodes` | `NodeElectrodes` |
| several of these at once | `CombinedElectrodes` | |

Where to put them: `jeit.layout`.
"""

from jeit.electrodes.boundary import BoundaryElectrodes as BoundaryElectrodes
from jeit.electrodes.combined import CombinedElectrodes as CombinedElectrodes
from jeit.electrodes.discs import FaceDiscs as FaceDiscs
from jeit.electrodes.discs import SheetDiscs as SheetDiscs
from jeit.electrodes.electrodes import AbstractElectrodes as AbstractElectrodes
from jeit.electrodes.facets import FacetElectrodes as FacetElectrodes
from jeit.electrodes.facets import electrodes_from_nodes as electrodes_from_nodes
from jeit.electrodes.facets import plates as plates
from jeit.electrodes.patches import FacePatches as FacePatches
from jeit.electrodes.point import NodeElectrodes as NodeElectrodes
from jeit.electrodes.point import PointElectrodes as PointElectrodes
