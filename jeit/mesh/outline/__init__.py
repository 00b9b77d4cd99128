"""Outlines in metres, without a mesh: `Domain`, which says what every outline can do, and one file for each."""

from __future__ import annotations

from jeit.mesh.outline.disk import Disk
from jeit.mesh.outline.domain import Domain, Pen
from jeit.mesh.outline.polygon import Polygon
from jeit.mesh.outline.rectangle import Rectangle

# By the name that `describe` gives them: what a file may ask for.
OUTLINES: dict[str, type[Domain]] = {"disk": Disk, "rectangle": Rectangle, "polygon": Polygon}

__all__ = [
    "OUTLINES",
    "Disk",
    "Domain",
    "Pen",
    "Polygon",
    "Rectangle",
]
