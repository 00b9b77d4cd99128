"""Inverse problems: calibration, priors, linear and nonlinear images, and rules that choose the hyperparameter.

Solvers, links and further unknowns are in `jeit.inverse.nonlinear`; classes of results are in the modules that compute
them.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
