"""The five attributes of touch of Silvera Tawil et al. 2011, section IV-A: measures of a skin's resolution.

Each is computed from recordings of a skin; `touch_attributes` requests all the touches that it needs, from a robot or a
simulated skin, and measures them all.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved import with_moved_names as _with_moved_names

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _find)
