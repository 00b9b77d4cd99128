from .parametrisation import Background, Bounded, ContactImpedance, ElectrodePosition, Linear, Log, Scale
from .solvers import LBFGSB, GaussNewton, LevenbergMarquardt, OneStep, ProjectedGradient

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
