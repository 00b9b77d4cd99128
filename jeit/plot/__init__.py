"""Pictures, with matplotlib: meshes, images, solids and surfaces in space, electrodes, sensitivity, taxels, layouts,
voltages, microphones, touches, contacts, self-organising maps, damage, gestures in time, depths.

Every function takes `ax`, makes a figure of its own where none is given, and returns the axes it drew on. Lengths are
in metres in the arguments and in millimetres in the pictures.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved import with_moved_names as _with_moved_names

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _find)
