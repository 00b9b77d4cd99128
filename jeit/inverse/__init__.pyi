from .calibration import Calibration, calibrate
from .channels import relative_noise, repeated_noise
from .hyperparameter.choice import Choice
from .hyperparameter.comparison import choose_hyperparameter, compare_rules
from .hyperparameter.rules import (
    RULES,
    best_resolution,
    discrepancy,
    generalised_cross_validation,
    l_curve,
    noise_figure,
)
from .linear.greit import greit
from .linear.one_step import LinearReconstruction, back_projection, one_step
from .nonlinear.parametrisation import (
    Background,
    Bounded,
    ContactImpedance,
    ElectrodePosition,
    Linear,
    Log,
    Parametrisation,
    Scale,
)
from .nonlinear.reconstruct import Reconstruction, reconstruct
from .nonlinear.solvers import LBFGSB, GaussNewton, LevenbergMarquardt, OneStep, ProjectedGradient
from .placement import ModelError, Placement, Uncertainty, place_electrodes
from .prior.bases import DenseBasis, pixels
from .prior.matern import Matern
from .prior.priors import AbstractPrior, Gaussian, Laplace, Noser, Tikhonov
from .prior.total_variation import TotalVariation
from .shapes import (
    Accuracy,
    Ellipsoid,
    EllipsoidPrior,
    Quantities,
    ShapeReconstruction,
    Star,
    StarPrior,
    reconstruct_shapes,
)
from .streaming.imager import Imager
from .streaming.stream import FrameImage, FrameStatus, StreamState, stream
from .uncertainty import (
    DetectableDiameters,
    Posterior,
    detectable_diameters,
    detectable_strength,
    image_noise,
    posterior,
)

__all__ = [
    "LBFGSB",
    "RULES",
    "AbstractPrior",
    "Accuracy",
    "Background",
    "Bounded",
    "Calibration",
    "Choice",
    "ContactImpedance",
    "DenseBasis",
    "DetectableDiameters",
    "ElectrodePosition",
    "Ellipsoid",
    "EllipsoidPrior",
    "FrameImage",
    "FrameStatus",
    "GaussNewton",
    "Gaussian",
    "Imager",
    "Laplace",
    "LevenbergMarquardt",
    "Linear",
    "LinearReconstruction",
    "Log",
    "Matern",
    "ModelError",
    "Noser",
    "OneStep",
    "Parametrisation",
    "Placement",
    "Posterior",
    "ProjectedGradient",
    "Quantities",
    "Reconstruction",
    "Scale",
    "ShapeReconstruction",
    "Star",
    "StarPrior",
    "StreamState",
    "Tikhonov",
    "TotalVariation",
    "Uncertainty",
    "back_projection",
    "best_resolution",
    "calibrate",
    "choose_hyperparameter",
    "compare_rules",
    "detectable_diameters",
    "detectable_strength",
    "discrepancy",
    "generalised_cross_validation",
    "greit",
    "image_noise",
    "l_curve",
    "noise_figure",
    "one_step",
    "pixels",
    "place_electrodes",
    "posterior",
    "reconstruct",
    "reconstruct_shapes",
    "relative_noise",
    "repeated_noise",
    "stream",
]
