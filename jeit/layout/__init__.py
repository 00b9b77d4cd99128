"""Layouts of electrodes: arrangements as arrays of positions, and `Layout`, a design with sizes, labels and an outline.

Arrangements: `ring`, `ring_and_centre`, `perimeter`, `grid`, `quasi_uniform`, and `spread` over surfaces in space.
Layouts: `named_layout`, or from and to a CSV, DXF or SVG file (`read_layout`, `write_layout`); `SurfaceLayout` of
curved skins, from a CSV file by `read_surface_layout`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
