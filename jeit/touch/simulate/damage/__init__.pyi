from .cut import Cut, draw_cut
from .electrode_fault import FAULTS, ElectrodeFault
from .recording import Mishap, record_mishaps
from .repair import mended

__all__ = [
    "FAULTS",
    "Cut",
    "ElectrodeFault",
    "Mishap",
    "draw_cut",
    "mended",
    "record_mishaps",
]
