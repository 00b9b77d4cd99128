"""Safe reading and writing of files: only numbers and text are read, within limits on size, and a file is written
either completely or not at all.

Nothing in a file is executed, and the size of its content is checked before memory is allocated. `jeit/files/limits.py`
states the limits, and how to raise them.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
