"""`check_flat`: for what works in the plane or in solids, and not on triangles in space."""

from __future__ import annotations

from jeit.mesh.mesh import Mesh


def check_flat(mesh: Mesh, what: str) -> None:
    """Raise `ValueError` for a surface in space: `what`, a plural such as "rasters", are of flat sheets and solids."""
    if mesh.is_surface:
        raise ValueError(
            f"mesh is a surface in space, and {what} are of flat sheets and solids; take the flat sheet that it was "
            "bent from, or a shell of it (jeit.mesh.shell)."
        )
