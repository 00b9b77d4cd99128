"""Layouts of electrodes: arrangements as arrays of positions, and `Layout`, a design with sizes, labels and an outline.

The functions `ring`, `ring_and_centre`, `perimeter`, `grid` and `quasi_uniform` compute arrangements in a plane, and
`spread` on surfaces in space. A `Layout` is created by name with `named_layout`, or read from and written to a CSV, DXF
or SVG file with `read_layout` and `write_layout`. A `SurfaceLayout` of a curved skin is read from a CSV file with
`read_surface_layout`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
