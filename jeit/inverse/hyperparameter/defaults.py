"""Default values of λ; GREIT and filtered back-projection have scales of their own."""

from __future__ import annotations

RULE = "noise-figure"
"""The rule that chooses λ of linear images, and of nonlinear problems linearised at the background."""
ITERATED = 5.0
"""λ of Gauss-Newton images of a tank against its reference, with a smooth prior: log σ varies by a fifth."""
EDGE_PRICE = 300.0
"""λ of total variation: what an edge as long as the body is wide costs, per unit of log σ."""
