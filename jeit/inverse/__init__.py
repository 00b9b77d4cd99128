"""Inverse problems: calibration, priors, linear and nonlinear images, and the rules that choose a hyperparameter.

Solvers, links and further unknowns are in `jeit.inverse.nonlinear`; the classes of results are in the modules that
compute them.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
