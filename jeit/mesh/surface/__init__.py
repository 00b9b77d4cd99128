"""Surfaces in space, and shells: sleeves, spheres, bent sheets, and what has a thickness above any of them."""

from __future__ import annotations

from jeit.mesh.surface.bending import bend
from jeit.mesh.surface.boundary import surface_of
from jeit.mesh.surface.shells import shell
from jeit.mesh.surface.sleeves import forearm, tube
from jeit.mesh.surface.spheres import cap, sphere
from jeit.mesh.surface.vertex_normals import node_normals

__all__ = ["bend", "cap", "forearm", "node_normals", "shell", "sphere", "surface_of", "tube"]
