from .all_at_once import haar, optimal, trigonometric
from .matrices import from_channels, from_matrices
from .patterns import adjacent, all_against_one, bipolar, opposite, reference_electrode, skip, two_terminal
from .potentials import measurement_patterns
from .protocol import Protocol

__all__ = [
    "Protocol",
    "adjacent",
    "all_against_one",
    "bipolar",
    "from_channels",
    "from_matrices",
    "haar",
    "measurement_patterns",
    "opposite",
    "optimal",
    "reference_electrode",
    "skip",
    "trigonometric",
    "two_terminal",
]
