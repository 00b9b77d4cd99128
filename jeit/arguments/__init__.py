"""What is said of arguments and files that cannot be right: another kind of thing, a name there is not, a length in
millimetres.

One sentence each, before anything is compiled: which argument, what was given, what to give. Beneath all rooms, and
light: nothing of the library is imported here.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
