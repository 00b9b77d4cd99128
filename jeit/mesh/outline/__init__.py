"""Outlines in metres, without a mesh: the base class `Domain`, and the outlines `Disk`, `Polygon` and `Rectangle`."""

from __future__ import annotations

from jeit.mesh.outline.disk import Disk
from jeit.mesh.outline.domain import Domain, Pen
from jeit.mesh.outline.straight_sided import Polygon, Rectangle

# Classes of outlines by the name of the shape that `describe` returns and files contain.
OUTLINES: dict[str, type[Domain]] = {"disk": Disk, "rectangle": Rectangle, "polygon": Polygon}

__all__ = [
    "OUTLINES",
    "Disk",
    "Domain",
    "Pen",
    "Polygon",
    "Rectangle",
]
