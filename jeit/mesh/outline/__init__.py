"""Outlines in metres, without a mesh: `Domain`, which says what every outline can do, and one file for each."""

from jeit.mesh.outline.disk import Disk as Disk
from jeit.mesh.outline.domain import Domain as Domain
from jeit.mesh.outline.domain import Pen as Pen
from jeit.mesh.outline.polygon import Polygon as Polygon
from jeit.mesh.outline.rectangle import Rectangle as Rectangle

# By the name that `describe` gives them: what a file may ask for.
OUTLINES: dict[str, type[Domain]] = {"disk": Disk, "rectangle": Rectangle, "polygon": Polygon}
