"""Where electrodes are: arrangements as arrays of positions, and `Layout`, a design with sizes, labels and an outline.

Arrangements: `ring`, `ring_and_centre`, `perimeter`, `grid`, `quasi_uniform`, and `spread` over surfaces in space.
Layouts: `named_layout`, or from and to a CSV, DXF or SVG file (`read_layout`, `write_layout`); `SurfaceLayout` of
curved skins, from a CSV file by `read_surface_layout`.
"""

from __future__ import annotations

from jeit.layout.arrangements import grid, perimeter, quasi_uniform, ring, ring_and_centre
from jeit.layout.even_spread import spread
from jeit.layout.files import read_layout, write_layout
from jeit.layout.layout import Layout
from jeit.layout.names import BUILT_IN, named_layout
from jeit.layout.surface_csv import read_surface_layout
from jeit.layout.surface_layout import SurfaceLayout

__all__ = [
    "BUILT_IN",
    "Layout",
    "SurfaceLayout",
    "grid",
    "named_layout",
    "perimeter",
    "quasi_uniform",
    "read_layout",
    "read_surface_layout",
    "ring",
    "ring_and_centre",
    "spread",
    "write_layout",
]
