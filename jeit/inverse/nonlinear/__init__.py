"""Nonlinear least squares for conductivity itself: what is estimated, on which scale, and what solves it."""

from __future__ import annotations

from jeit.inverse.nonlinear.links import Bounded, Linear, Log
from jeit.inverse.nonlinear.solvers import LBFGSB, GaussNewton, LevenbergMarquardt, OneStep, ProjectedGradient
from jeit.inverse.nonlinear.unknowns import Background, ContactImpedance, ElectrodePosition, Scale

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
