"""Simulation of damaged skins: cuts, faulty electrodes, and repair.

Voltages are computed for the conductivity of the damaged skin, on a mesh that is fine along the cut. Simulated readings
include the drift, gains and noise of the material, which continue when damage occurs.
"""

from __future__ import annotations

import lazy_loader

from jeit.arguments.moved_names import with_moved_names as _with_moved_names

_load_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = _with_moved_names(__name__, _load_attribute)
