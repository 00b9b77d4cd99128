from .all_at_once import from_channels, from_matrices, haar, measurement_patterns, optimal, trigonometric
from .patterns import adjacent, all_against_one, bipolar, opposite, reference_electrode, skip, two_terminal
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
