"""Simulation of an acoustic skin with microphones, and of the sound of touches on it."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
