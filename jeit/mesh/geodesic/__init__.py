"""Ways along triangulated surfaces in space: their lengths, the places that they join, and surfaces unrolled."""

from __future__ import annotations

from jeit.mesh.geodesic.geodesics import Geodesics
from jeit.mesh.geodesic.triangles import SurfacePlaces, Triangles
from jeit.mesh.geodesic.unfolding import Unfolding, unfold
from jeit.mesh.geodesic.unrolled import Unrolled, unroll

__all__ = ["Geodesics", "SurfacePlaces", "Triangles", "Unfolding", "Unrolled", "unfold", "unroll"]
