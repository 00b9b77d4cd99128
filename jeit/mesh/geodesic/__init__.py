"""Geodesics on triangulated surfaces in space: their lengths, places on surfaces, and surfaces unrolled into the
plane."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
