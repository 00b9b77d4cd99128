"""From two frames to a picture in one call, `image_difference`, and what every rule for λ would choose on the way.

`settings` says how to image, `preparation` checks, meshes and calibrates, `wiring` finds what is not wired as told,
`method` images, `automatic` decides how, `difference` looks for inclusions, `sequence` images many frames at once;
`stream_preparation` makes ready for frame after frame. And from a stream of a touched skin to what it means:
`touch_images`, `gesture_learning`, `touch_watch`; `health_learning`, what it is like while it is healthy.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved import with_moved_names as _with_moved_names

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _find)
