"""Solutions of the conductivity equation in closed form or as series, for verification of the forward model.

The solutions are computed in plain NumPy without finite elements, so that agreement with the forward model is agreement
of two independent methods. Lengths are in metres, currents in amperes, conductivities of sheets in siemens and of
solids in siemens per metre; admittivities and contact impedances may be complex.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
