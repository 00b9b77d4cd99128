"""Live imaging of the frames that a device sends: sources of frames, recordings, and a page in the browser."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
