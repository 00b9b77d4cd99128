"""Inverse problems: calibration, priors, linear and nonlinear images, and the rules that choose a hyperparameter.

Solvers, links and further unknowns are in `jeit.inverse.nonlinear`; the classes of results are in the modules that
compute them.
"""

from __future__ import annotations

from jeit.arguments.moved import tell_old_names as _tell_old_names
from jeit.inverse.calibration import calibrate
from jeit.inverse.channel_weights import relative_noise
from jeit.inverse.hyperparameter.comparison import choose_hyperparameter, compare_rules
from jeit.inverse.hyperparameter.rules import RULES
from jeit.inverse.linear.back_projection import back_projection
from jeit.inverse.linear.greit import greit
from jeit.inverse.linear.one_step import one_step
from jeit.inverse.nonlinear.parametrisation import Parametrisation
from jeit.inverse.nonlinear.reconstruct import reconstruct
from jeit.inverse.prior.matern import Matern
from jeit.inverse.prior.priors import Gaussian, Laplace, Noser, Tikhonov
from jeit.inverse.prior.total_variation import TotalVariation
from jeit.inverse.streaming.imager import Imager
from jeit.inverse.streaming.stream import stream
from jeit.inverse.uncertainty import posterior

_tell_old_names(__name__)

__all__ = [
    "RULES",
    "Gaussian",
    "Imager",
    "Laplace",
    "Matern",
    "Noser",
    "Parametrisation",
    "Tikhonov",
    "TotalVariation",
    "back_projection",
    "calibrate",
    "choose_hyperparameter",
    "compare_rules",
    "greit",
    "one_step",
    "posterior",
    "reconstruct",
    "relative_noise",
    "stream",
]
