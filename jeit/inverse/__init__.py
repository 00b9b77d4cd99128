"""Inverse problems: calibration, priors, linear images, and the rules that choose a hyperparameter."""

from jeit.inverse.back_projection import back_projection as back_projection
from jeit.inverse.calibrate import Calibration as Calibration
from jeit.inverse.calibrate import calibrate as calibrate
from jeit.inverse.hyperparameter import RULES as RULES
from jeit.inverse.linear import LinearReconstruction as LinearReconstruction
from jeit.inverse.linear import one_step as one_step
from jeit.inverse.links import AbstractLink as AbstractLink
from jeit.inverse.links import Bounded as Bounded
from jeit.inverse.links import Linear as Linear
from jeit.inverse.links import Log as Log
from jeit.inverse.noise import relative_noise as relative_noise
from jeit.inverse.priors import AbstractPrior as AbstractPrior
from jeit.inverse.priors import Gaussian as Gaussian
from jeit.inverse.priors import Laplace as Laplace
from jeit.inverse.priors import Noser as Noser
from jeit.inverse.priors import Tikhonov as Tikhonov
from jeit.inverse.reconstruct import Inversion as Inversion
from jeit.inverse.reconstruct import Reconstruction as Reconstruction
from jeit.inverse.reconstruct import reconstruct as reconstruct
