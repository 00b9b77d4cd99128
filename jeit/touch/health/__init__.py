"""Whether a skin is still what it was: cuts, electrodes that fail, and repair, told from frames, and with a model."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
