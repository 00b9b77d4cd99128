"""Skins that get damaged: cuts, electrodes that fail, and repair.

Voltages are solved anew on the damaged conductivity, whose mesh is fine along the cut; readings have the drift, gains
and noise of the material, and go on through the damage.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
