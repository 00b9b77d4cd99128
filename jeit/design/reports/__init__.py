"""Reports, tables and plots of electrode layouts and studies of layouts, written to a folder."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
