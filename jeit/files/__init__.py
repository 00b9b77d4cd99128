"""Safe reading and writing of files: files from any source are read within limits, as plain numbers and text, and files
are written whole or not at all.

Nothing that a file holds is executed, and nothing in it decides how much memory is taken before its size has been
checked: see `jeit/files/limits.py` for how much, and how to allow more.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
