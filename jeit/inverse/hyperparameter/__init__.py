"""Rules that choose the hyperparameter λ, the curves on which the rules are based, and a comparison of rules on the
same data."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
