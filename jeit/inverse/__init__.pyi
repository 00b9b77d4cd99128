from .calibration import calibrate
from .channels import relative_noise
from .hyperparameter.comparison import choose_hyperparameter, compare_rules
from .hyperparameter.rules import RULES
from .linear.greit import greit
from .linear.one_step import back_projection, one_step
from .nonlinear.parametrisation import Parametrisation
from .nonlinear.reconstruct import reconstruct
from .placement import Uncertainty, place_electrodes
from .prior.bases import DenseBasis
from .prior.matern import Matern
from .prior.priors import AbstractPrior, Gaussian, Laplace, Noser, Tikhonov
from .prior.total_variation import TotalVariation
from .streaming.imager import Imager
from .streaming.stream import stream
from .uncertainty import posterior

__all__ = [
    "RULES",
    "AbstractPrior",
    "DenseBasis",
    "Gaussian",
    "Imager",
    "Laplace",
    "Matern",
    "Noser",
    "Parametrisation",
    "Tikhonov",
    "TotalVariation",
    "Uncertainty",
    "back_projection",
    "calibrate",
    "choose_hyperparameter",
    "compare_rules",
    "greit",
    "one_step",
    "place_electrodes",
    "posterior",
    "reconstruct",
    "relative_noise",
    "stream",
]
