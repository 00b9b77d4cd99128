from .cut import Cut, draw_cut, mend_cut
from .recording import FAULTS, DamageEvent, ElectrodeFault, record_damage

__all__ = [
    "FAULTS",
    "Cut",
    "DamageEvent",
    "ElectrodeFault",
    "draw_cut",
    "mend_cut",
    "record_damage",
]
