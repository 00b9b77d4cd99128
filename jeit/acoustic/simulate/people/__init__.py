"""People who pat, tickle, stroke and blow on a skin with microphones, each in a way of their own."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
