"""The physics of contact: from load to pressure, to change of conductivity over time, to voltages.

An indenter defines the height of its surface above its lowest point, and a support how pressure spreads beneath it.
Arrays are NumPy's, since contact is not a smooth function of its parameters.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
