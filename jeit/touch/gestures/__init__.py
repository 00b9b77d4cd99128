"""Gestures: a stream of images cut into touches, what is measured of each, and which of the learnt gestures it is."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
