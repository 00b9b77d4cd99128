"""Classify gestures: segment a stream of images into touches, compute features of each, and predict its gesture."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
