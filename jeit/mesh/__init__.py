"""Meshes: points, cells, boundary facets and tags; shapes to mesh; outlines; files."""

from jeit.mesh.domain import Disk, Domain, Polygon, Rectangle
from jeit.mesh.geometry import (
    boundary_arc_length,
    centroids,
    facet_centroids,
    facet_measures,
    gradients,
    measures,
)
from jeit.mesh.interior import interior_facets
from jeit.mesh.mesh import Mesh
from jeit.mesh.refine import Refine
from jeit.mesh.shapes import disk, polygon, rectangle

__all__ = [
    "Disk",
    "Domain",
    "Mesh",
    "Polygon",
    "Rectangle",
    "Refine",
    "boundary_arc_length",
    "centroids",
    "disk",
    "facet_centroids",
    "facet_measures",
    "gradients",
    "interior_facets",
    "measures",
    "polygon",
    "rectangle",
]
