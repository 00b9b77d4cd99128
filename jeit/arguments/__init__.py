"""Checks and error messages for invalid arguments and files: a wrong type, an unknown name, a length in millimetres.

Each message is one sentence, raised before anything is compiled: which argument, what was given, what to give. This is
the lowest layer of the library: it imports nothing from the other packages of jeit.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
