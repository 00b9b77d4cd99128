"""Default values of a skin, its measurement and its touches, shared by the Python API, studies and commands.

The skin and its touches are those of Park et al., Science Robotics 7, eabm7187 (2022), text S4; SI units throughout.
"""

from __future__ import annotations

from typing import Literal

# The hydrogel skin: a square if the layout has no outline. Thickness and conductivity scale all voltages by the same
# factor, apart from the influence of the contact impedances.
SIDE = 0.2  # m
THICKNESS = 10e-3  # m
CONDUCTIVITY = 1.0  # S/m
# Contact impedance, for which Park et al. give no value. With 1e-4 ohm·m², the contact resistance of an electrode 6 mm
# in diameter is 3.5 ohm, 4 % of the spreading resistance 1/(4σr) = 83 ohm of a deep skin of 1 S/m, so the skin
# dominates. The results in docs/reference/layout-figures.md are computed with this value.
CONTACT_IMPEDANCE = 1e-4  # ohm·m²
# Two-terminal measurements between the nearest electrodes: as many pairs as in Park et al., or all pairs if fewer.
PROTOCOL = "two-terminal"
NUM_PAIRS = 94
CURRENT = 1e-3  # A
# Standard deviation of the noise of a voltage: 80 dB below the root mean square, 0.18 V, of the voltages between two
# electrodes of this skin at 1 mA. A good instrument reaches this signal-to-noise ratio, which the skins of
# jeit.simulate have too.
NOISE = 2e-5  # V

# The touch: the unit deformation of Park et al., or a ball as in their experiments. The indenter is an insulator.
DEPTH = 2.5e-3  # m
DEVIATION = 7.5e-3  # m
BALL_DIAMETER = 15e-3  # m
CONTRAST = 0.0
# Number of touched positions along a side of the skin: as in Park et al. for a single layout, and half as many in a
# study, which covers many layouts.
NUM_PLACES_PER_SIDE = 48
NUM_STUDY_PLACES_PER_SIDE = 24
# Minimum distance of a touch from the edge of the skin; a touch closer to the edge would lie partly outside the skin.
MARGIN = 10e-3  # m

# The mesh: an electrode of 6 mm spans 1.3 cells, and the centroids of the top layer of cells are 0.5 mm below the
# surface.
CELL_SIZE = 4.5e-3  # m
NUM_LAYERS = 5

# Maximum contrast of a touch: at higher contrasts the exact computation does not converge, and the voltages no longer
# depend on the contrast.
MAX_CONTRAST = 1e6

# Virtual taxels: number of clusters and threshold of the cosine similarity, as in Park et al.
NUM_TAXELS = 90
THRESHOLD = 0.7
# Correlation length of the touch amplitudes under the prior: twice the standard deviation of the touch's profile.
CORRELATION = 15e-3  # m
# Temperature T of the smooth minimum of the sensitivity; the minimum is exact for T → 0.
TEMPERATURE = 0.1

# Layout optimisation: approximate number of nodes of the sheet's mesh, kept small since every step computes a gradient;
# number of steps; and minimum distance of the electrodes' centres, which leaves 2 mm between electrodes of 6 mm.
NUM_POINTS = 1300
STEPS = 60
MINIMUM_SPACING = 8e-3  # m

# Names of the scores of layouts that a study can compute.
ScoreName = Literal[
    "minimum",
    "mean",
    "uniformity",
    "blind_spot",
    "taxels",
    "information",
    "mean_variance",
    "largest_variance",
    "localisation_error",
]
# Scores that are computed for sheets only, from linearised voltage changes and a prior: see
# `jeit.design.layout_scores`.
SHEET_ONLY_SCORES = ("information", "mean_variance", "largest_variance", "localisation_error")
