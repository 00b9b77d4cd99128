"""Find contacts in images of change, track them from frame to frame, and estimate their loads."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
