"""The hyperparameter λ: rules that choose it, the curves they look at, and what all of them say of the same data."""

from jeit.inverse.hyperparameter.point_spread import best_resolution as best_resolution
from jeit.inverse.hyperparameter.rules import discrepancy as discrepancy
from jeit.inverse.hyperparameter.rules import generalised_cross_validation as generalised_cross_validation
from jeit.inverse.hyperparameter.rules import l_curve as l_curve
from jeit.inverse.hyperparameter.rules import noise_figure as noise_figure
