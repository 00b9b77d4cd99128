"""Meshes and outlines: creation, geometry, quality, and file input and output.

Outlines without a mesh: `Disk`, `Rectangle`, `Polygon`. Plane meshes: `disk`, `rectangle`, `polygon`, refined locally
with `Refine`. Solids: `layer`, `box`, `cylinder`. Surfaces in space: `tube`, `forearm`, `sphere`, `cap`, `bend`, and
`surface_of` a solid; `shell` thickens a surface to a solid. Meshes from other sources: `Mesh.create`, `read`,
`from_gmsh`. Distances along a surface: `Geodesics`; its flattening: `unroll`. Measurements are made on a `Body`, which
is an outline, a `Solid` or an `OwnMesh`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
