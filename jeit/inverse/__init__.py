"""Inverse problems: calibration, priors, linear and nonlinear images, and the rules that choose a hyperparameter.

Solvers, links and further unknowns are in `jeit.inverse.nonlinear`; the classes of results are in the modules that
compute them.
"""

from jeit.inverse.calibration import calibrate as calibrate
from jeit.inverse.hyperparameter.comparison import choose_hyperparameter as choose_hyperparameter
from jeit.inverse.hyperparameter.comparison import compare_rules as compare_rules
from jeit.inverse.hyperparameter.rules import RULES as RULES
from jeit.inverse.linear.back_projection import back_projection as back_projection
from jeit.inverse.linear.greit import greit as greit
from jeit.inverse.linear.one_step import one_step as one_step
from jeit.inverse.noise import relative_noise as relative_noise
from jeit.inverse.nonlinear.parametrisation import Parametrisation as Parametrisation
from jeit.inverse.nonlinear.reconstruct import reconstruct as reconstruct
from jeit.inverse.prior.priors import Gaussian as Gaussian
from jeit.inverse.prior.priors import Laplace as Laplace
from jeit.inverse.prior.priors import Noser as Noser
from jeit.inverse.prior.priors import Tikhonov as Tikhonov
from jeit.inverse.prior.total_variation import TotalVariation as TotalVariation
from jeit.inverse.streaming.imager import Imager as Imager
from jeit.inverse.streaming.stream import stream as stream
from jeit.inverse.uncertainty import posterior as posterior
