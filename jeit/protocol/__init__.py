"""Protocols: which currents are driven and which voltages are read, as matrices with names and units."""

from jeit.protocol.matrices import from_channels as from_channels
from jeit.protocol.matrices import from_matrices as from_matrices
from jeit.protocol.patterns import adjacent as adjacent
from jeit.protocol.patterns import all_against_one as all_against_one
from jeit.protocol.patterns import bipolar as bipolar
from jeit.protocol.patterns import opposite as opposite
from jeit.protocol.patterns import reference_electrode as reference_electrode
from jeit.protocol.patterns import skip as skip
from jeit.protocol.patterns import trigonometric as trigonometric
from jeit.protocol.patterns import two_terminal as two_terminal
from jeit.protocol.protocol import Protocol as Protocol
