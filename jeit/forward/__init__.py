"""The forward problem: P1 assembly, the electrode model, and `ForwardModel` with its derivative rule."""

from jeit.forward.model import ForwardModel as ForwardModel
from jeit.forward.system import System as System
from jeit.forward.transfer import electrode_fields as electrode_fields
from jeit.forward.transfer import transfer_impedance as transfer_impedance
