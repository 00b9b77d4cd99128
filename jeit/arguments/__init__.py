"""Checks and error messages for invalid arguments and files: a wrong type, an unknown name, a length in millimetres.

Each error is raised before anything is compiled; its message states in one sentence which argument is invalid, what its
value is, and which values are valid. This package imports nothing from the other packages of jeit.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
