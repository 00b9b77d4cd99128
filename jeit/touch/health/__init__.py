"""Monitor a skin for damage: detect cuts, failing electrodes and repairs from frames, and locate cuts with a model."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
