"""The forward problem: P1 assembly, the electrode model, and `ForwardModel` with its derivative rule."""

from jeit.forward.model import ForwardModel
from jeit.forward.transfer import transfer_impedance

__all__ = [
    "ForwardModel",
    "transfer_impedance",
]
