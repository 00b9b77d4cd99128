"""Analysis of images: rasters of values on a mesh, sections and isosurfaces of solids, inclusions, and series of images
over time."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
