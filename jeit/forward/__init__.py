"""The forward problem: P1 assembly, the electrode model, and `ForwardModel` with its derivative rule."""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.forward.model import ForwardModel
from jeit.forward.transfer import transfer_impedance

_tell_old_names(__name__)

__all__ = [
    "ForwardModel",
    "transfer_impedance",
]
