"""Bodies as shapes with few parameters: what is told of a body where voltages tell too little for an image."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
