"""Default values of λ. GREIT and filtered back-projection scale λ differently and have their own defaults."""

from __future__ import annotations

RULE = "noise-figure"
"""Default rule that chooses λ, for linear images and for nonlinear problems linearised at the background."""
ITERATED = 5.0
"""Default λ of Gauss-Newton images of a tank relative to a reference frame, with a smooth prior; the prior standard
deviation of log σ is then a fifth."""
EDGE_PRICE = 300.0
"""Default λ of total variation: penalty of an edge as long as the body is wide, per unit of log σ."""
