"""Monitor a skin for damage: detect cuts, failing electrodes and repair from frames, and with a model locate cuts."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
