"""What was simulated here is simulated in `jeit.touch.simulate`, `jeit.acoustic.simulate` and `jeit.data` now."""

from __future__ import annotations

from jeit.arguments.moved import with_moved_names as _with_moved_names

__getattr__ = _with_moved_names(__name__)
