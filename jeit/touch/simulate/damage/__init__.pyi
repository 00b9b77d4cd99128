from .cut import Cut, draw_cut, mend_cut
from .recording import FAULTS, ElectrodeFault, Mishap, record_mishaps

__all__ = [
    "FAULTS",
    "Cut",
    "ElectrodeFault",
    "Mishap",
    "draw_cut",
    "mend_cut",
    "record_mishaps",
]
