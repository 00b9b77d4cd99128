"""The `jeit` command line: one file for each command, and `app`, which combines them.

The commands import what they need when they run, so that `jeit --help` answers at once.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
