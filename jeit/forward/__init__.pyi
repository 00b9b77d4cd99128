from .model import ForwardModel
from .transfer import transfer_impedance

__all__ = [
    "ForwardModel",
    "transfer_impedance",
]
