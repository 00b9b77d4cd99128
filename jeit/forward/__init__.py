"""The forward problem: P1 assembly, the electrode model, and `ForwardModel` with its derivative rule."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
