"""Simulate damage of skins: cuts, electrodes that fail, and repair.

Voltages are computed for the damaged conductivity, on a mesh that is fine along the cut; readings have the drift, gains
and noise of the material, which continue through the damage.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
