"""`surface_of`: the boundary of a solid, or a named part of it, as a surface in space."""

from __future__ import annotations

import numpy as np

from jeit.arguments import check_name
from jeit.mesh.mesh import Mesh
from jeit.mesh.sizes import size_told


def surface_of(mesh: Mesh, tag: str | None = None) -> Mesh:
    """The boundary triangles of a solid, those of one `tag` or all, as a surface in space that faces outward.

    Raises `ValueError` for a mesh that is no solid, for a tag that it does not have, and where the triangles are no
    surface, as those of a shell are not: it has two, 'inner' and 'outer'.
    """
    if mesh.dimension != 3:
        raise ValueError("mesh: only solids have a boundary surface; this one consists of triangles.")
    facets = np.asarray(mesh.facets)
    if tag is not None:
        check_name("tag", tag, mesh.tags)
        facets = facets[np.asarray(mesh.tags[tag])]
    used, cells = np.unique(facets, return_inverse=True)
    with size_told():
        return Mesh.create(np.asarray(mesh.points)[used], cells.reshape(facets.shape))
