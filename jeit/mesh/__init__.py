"""The mesh room: outlines, meshes of them, their geometry, their quality, and files.

Outlines without a mesh: `Disk`, `Rectangle`, `Polygon`. Plane meshes: `disk`, `rectangle`, `polygon`, made finer
where a `Refine` asks. Solids: `layer`, `box`, `cylinder`. Surfaces in space: `tube`, `forearm`, `sphere`, `cap`, `bend`
and `surface_of` a solid, and what has a thickness on them, a `shell`. From elsewhere: `Mesh.create`, `read`,
`from_gmsh`. What was measured on, any of these: a `Body`, which is an outline, a `Solid` or an `OwnMesh`.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.mesh.bisection import bisect, cut
from jeit.mesh.body import Body
from jeit.mesh.cell_quality import quality
from jeit.mesh.files import read, write
from jeit.mesh.flatness import check_flat
from jeit.mesh.generate.refine import Refine
from jeit.mesh.geometry import centroids, gradients, measures, normals
from jeit.mesh.gmsh import from_gmsh
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Disk, Domain, Polygon, Rectangle
from jeit.mesh.shapes import disk, polygon, rectangle
from jeit.mesh.solid_body import OwnMesh, Solid
from jeit.mesh.solids import box, cylinder, layer
from jeit.mesh.surface import bend, cap, forearm, node_normals, shell, sphere, surface_of, tube

_tell_old_names(__name__)

__all__ = [
    "Body",
    "Disk",
    "Domain",
    "Mesh",
    "OwnMesh",
    "Polygon",
    "Rectangle",
    "Refine",
    "Solid",
    "bend",
    "bisect",
    "box",
    "cap",
    "centroids",
    "check_flat",
    "cut",
    "cylinder",
    "disk",
    "forearm",
    "from_gmsh",
    "gradients",
    "layer",
    "measures",
    "node_normals",
    "normals",
    "polygon",
    "quality",
    "read",
    "rectangle",
    "shell",
    "sphere",
    "surface_of",
    "tube",
    "write",
]
