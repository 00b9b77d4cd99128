"""The forward problem: finite elements of first order (P1), electrode models, and `ForwardModel` with its
derivatives."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
