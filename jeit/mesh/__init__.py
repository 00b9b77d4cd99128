"""Meshes: outlines, meshes of them, their geometry, their quality, and files.

Outlines without a mesh: `Disk`, `Rectangle`, `Polygon`. Plane meshes: `disk`, `rectangle`, `polygon`, made finer where
a `Refine` asks. Solids: `layer`, `box`, `cylinder`. Surfaces in space: `tube`, `forearm`, `sphere`, `cap`, `bend` and
`surface_of` a solid, and what has a thickness on them, a `shell`. From elsewhere: `Mesh.create`, `read`, `from_gmsh`. A
`Body`, on which measurements are made, is any of these: an outline, a `Solid` or an `OwnMesh`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
