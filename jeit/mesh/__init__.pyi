from .bisection import bisect, cut
from .cell_quality import Quality, quality
from .files import read, write
from .generate.refine import Refine
from .geodesic import Geodesics, SurfacePlaces, Triangles, Unfolding, Unrolled, unfold, unroll
from .gmsh import from_gmsh
from .mesh import Mesh, centroids, check_flat, gradients, measures, normals
from .outline import Disk, Domain, Polygon, Rectangle
from .outline.domain import Body
from .solid_body import OwnMesh, Solid
from .solids import box, cylinder, disk, layer, polygon, rectangle
from .surface import bend, cap, forearm, node_normals, shell, sphere, surface_of, tube

__all__ = [
    "Body",
    "Disk",
    "Domain",
    "Geodesics",
    "Mesh",
    "OwnMesh",
    "Polygon",
    "Quality",
    "Rectangle",
    "Refine",
    "Solid",
    "SurfacePlaces",
    "Triangles",
    "Unfolding",
    "Unrolled",
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
    "unfold",
    "unroll",
    "write",
]
