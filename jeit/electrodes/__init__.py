"""Electrodes: position, size, contact impedance, and contact integrals.

| where | complete electrodes | point electrodes |
|---|---|---|
| edge of a sheet (2-D) | `BoundaryElectrodes` | `PointElectrodes` |
| inside a sheet (2-D) | `SheetDiscs` | `PointElectrodes` |
| inside a curved sheet | `SurfaceDiscs` | `PointElectrodes` |
| faces of a 3-D body | `FaceDiscs`, `FacePatches` | `PointElectrodes` |
| whole facets of a mesh, nodes of a mesh | `FacetElectrodes`, `plates`, `electrodes_from_nodes` | `NodeElectrodes` |
| several of these at once | `CombinedElectrodes` | |

For the placement of electrodes see `jeit.layout`.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
