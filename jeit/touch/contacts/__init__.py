"""Contacts found in images of change, followed from frame to frame, and what load each carries."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
