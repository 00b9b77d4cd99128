"""Surfaces in space (sleeves, spheres, bent sheets) and shells, which are solids of a certain thickness on a
surface."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
