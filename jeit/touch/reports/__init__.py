"""Write reports, tables and pictures of touches, and of models learnt from touches, to folders."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
