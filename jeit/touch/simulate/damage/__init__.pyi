from .cut import Cut, draw_cut, mended
from .recording import FAULTS, ElectrodeFault, Mishap, record_mishaps

__all__ = [
    "FAULTS",
    "Cut",
    "ElectrodeFault",
    "Mishap",
    "draw_cut",
    "mended",
    "record_mishaps",
]
