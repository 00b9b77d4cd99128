from .csv_file import read_surface_layout
from .files import read_layout, write_layout
from .layout import Layout
from .names import BUILT_IN, grid, named_layout, perimeter, quasi_uniform, ring, ring_and_centre
from .surface_layout import SurfaceLayout, spread

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
