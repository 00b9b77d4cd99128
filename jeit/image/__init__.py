"""Analysis of images: rasters of values on a mesh, planes and surfaces through a solid, inclusions, and regions over
time."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
