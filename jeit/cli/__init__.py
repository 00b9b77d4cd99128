"""The `jeit` command line: one module for each command, and the module `app`, which combines the commands.

Modules of commands import other modules only when a command runs, so that `jeit --help` responds quickly.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
