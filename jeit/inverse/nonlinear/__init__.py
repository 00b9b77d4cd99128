"""Nonlinear least squares for conductivity itself: what is estimated, on which scale, and what solves it."""

from jeit.inverse.nonlinear.links import Bounded as Bounded
from jeit.inverse.nonlinear.links import Linear as Linear
from jeit.inverse.nonlinear.links import Log as Log
from jeit.inverse.nonlinear.solvers import LBFGSB as LBFGSB
from jeit.inverse.nonlinear.solvers import GaussNewton as GaussNewton
from jeit.inverse.nonlinear.solvers import LevenbergMarquardt as LevenbergMarquardt
from jeit.inverse.nonlinear.solvers import OneStep as OneStep
from jeit.inverse.nonlinear.solvers import ProjectedGradient as ProjectedGradient
from jeit.inverse.nonlinear.unknowns import Background as Background
from jeit.inverse.nonlinear.unknowns import ContactImpedance as ContactImpedance
from jeit.inverse.nonlinear.unknowns import ElectrodePosition as ElectrodePosition
from jeit.inverse.nonlinear.unknowns import Scale as Scale
