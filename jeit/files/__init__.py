"""Safe reading and writing of files: files from any source are read within limits, as plain numbers and text, and files
are written either completely or not at all.

Nothing in a file is executed, and its size is checked before memory is allocated for its content: see
`jeit/files/limits.py` for the limits, and how to raise them.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
