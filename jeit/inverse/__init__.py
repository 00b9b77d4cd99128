"""Inverse problems: calibration, priors, linear and nonlinear images, and rules that choose the hyperparameter.

Linear images: `one_step`, `greit`, `back_projection`. Absolute images: `reconstruct`, with a prior, a solver and a
`Parametrisation` (link and further unknowns), and `posterior` for the uncertainty of images. Inclusions described by
few parameters: `reconstruct_shapes`. Images of successive frames: `Imager`, `stream`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
