"""Protocols: which currents are driven and which voltages are read, as matrices with names and units."""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.protocol.all_at_once import haar, optimal, trigonometric
from jeit.protocol.matrices import from_channels, from_matrices
from jeit.protocol.patterns import (
    adjacent,
    all_against_one,
    bipolar,
    opposite,
    reference_electrode,
    skip,
    two_terminal,
)
from jeit.protocol.potentials import measurement_patterns
from jeit.protocol.protocol import Protocol

_tell_old_names(__name__)

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
