"""The `jeit` command line: one file for each command, and `app`, which combines the commands.

Commands import other modules only when they run, so that `jeit --help` responds quickly.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
