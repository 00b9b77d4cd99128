from .parametrisation import Bounded, Linear, Log
from .solvers import LBFGSB, GaussNewton, LevenbergMarquardt, OneStep, ProjectedGradient
from .unknowns import Background, ContactImpedance, ElectrodePosition, Scale

__all__ = [
    "LBFGSB",
    "Background",
    "Bounded",
    "ContactImpedance",
    "ElectrodePosition",
    "GaussNewton",
    "LevenbergMarquardt",
    "Linear",
    "Log",
    "OneStep",
    "ProjectedGradient",
    "Scale",
]
