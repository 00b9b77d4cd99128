"""Imaging in one call: `image_difference` makes an image of two frames, `compare_on_data` compares the rules for λ on
them.

`settings` holds the settings, `preparation` checks, meshes and calibrates, `wiring` finds wiring that is not as
described, `method` images, `automatic` chooses the method, `difference` finds inclusions, `sequence` images many frames
at once and `stream_preparation` prepares for imaging frame after frame. Streams of a touched skin are in `jeit.touch`.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved import with_moved_names as _with_moved_names

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _find)
