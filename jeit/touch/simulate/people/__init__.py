"""Simulation of people who touch a skin: how each person makes each of six gestures, and the readings of the skin."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
