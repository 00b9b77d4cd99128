"""Contact mechanics of pressed skins: from load to pressure, to the change of conductivity over time, to voltages.

An indenter defines the height of its surface above its lowest point; a support, the elastic body under the skin,
defines the pressure beneath the indenter. Arrays are NumPy arrays, since contact is not a smooth function of its
parameters.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
