"""The physics of contact: load → pressure → change of conductivity, in time → voltages.

An indenter says how far its surface is above its lowest point, and a support how pressure spreads beneath it.
Arrays are NumPy's: what touches what is no smooth function of anything.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
