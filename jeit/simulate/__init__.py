"""Deprecated: the simulations are now in `jeit.touch.simulate`, `jeit.acoustic.simulate` and `jeit.data`."""

from __future__ import annotations

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

__getattr__ = _with_moved_names(__name__)
