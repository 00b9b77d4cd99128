"""Estimate places of touches by Kohonen's self-organising map, learnt from a skin's frames without a physical model.

`jeit.touch.learnt` offers the map as the method "som" of `jeit touch fit`.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
