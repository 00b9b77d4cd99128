"""Skins that get damaged: cuts, electrodes that fail, and repair.

Voltages are solved anew on the damaged conductivity, whose mesh is fine along the cut; readings have the drift, gains
and noise of the material, and go on through the damage.
"""

from __future__ import annotations

from jeit.simulate.damage.cut import Cut, draw_cut
from jeit.simulate.damage.electrode_fault import FAULTS, ElectrodeFault
from jeit.simulate.damage.recording import Mishap, record_mishaps
from jeit.simulate.damage.repair import mended

__all__ = ["FAULTS", "Cut", "ElectrodeFault", "Mishap", "draw_cut", "mended", "record_mishaps"]
