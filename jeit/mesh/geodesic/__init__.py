"""Geodesics on triangulated surfaces in space: geodesic distances, points on surfaces, and unrolling of surfaces into
the plane."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
