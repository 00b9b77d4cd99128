"""Networks trained from arrays, and kept as files.

`fit` trains any equinox network by Adam, stops early, and goes on where it was killed; `write_model` and `read_model`
keep networks as numbers with a JSON head, never a pickle. Training needs the extra `learn`; what is trained does not.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
