"""Ways along triangulated surfaces in space: their lengths, the places that they join, and surfaces unrolled."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
