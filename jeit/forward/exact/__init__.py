"""Solutions of the conductivity equation in closed form or by series, for verification of the forward model.

They are plain NumPy, and use no finite elements: agreement with the forward model is an agreement of two methods. All
lengths in metres, currents in amperes, sheet conductivity in siemens, that of solids in siemens per metre;
admittivities and contact impedances may be complex.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
