"""Kohonen's self-organising map: a skin's frames learnt without a model, and what the map then says of touches.

Rooms beside it: `jeit.touch.learnt` has it as a method, "som", of `jeit touch fit`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
