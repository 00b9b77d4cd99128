"""Default values of a skin, its measurement and its touches, shared by the Python API, studies and commands.

The skin and its touches are those of Park et al., Science Robotics 7, eabm7187 (2022), text S4; SI units throughout.
"""

# The hydrogel: a square, where no layout says its outline. Thickness and conductivity scale all voltages, and no
# ratio of them but those that contact impedances have a part in.
from __future__ import annotations

SIDE = 0.2  # m
THICKNESS = 10e-3  # m
CONDUCTIVITY = 1.0  # S/m
# The paper prints none. That of a disc 6 mm across is then 3.5 ohm, 4 % of the 83 ohm 1/(4σr) that a deep skin of
# 1 S/m spreads its current against: electrodes that the skin decides on, and the figures of docs/design.md are of it.
CONTACT_IMPEDANCE = 1e-4  # ohm·m²
# Between the nearest electrodes, two-terminal, as many as the paper's; of all if a skin has fewer.
PROTOCOL = "two-terminal"
NUM_PAIRS = 94
CURRENT = 1e-3  # A
# 80 dB below the voltages between two electrodes of that skin at that current, 0.18 V in the mean of squares: what a
# good instrument reaches, and the signal-to-noise ratio of jeit.simulate's skins too.
NOISE = 2e-5  # V

# The touch: the paper's unit deformation, or a ball as in its experiments; an insulator.
DEPTH = 2.5e-3  # m
DEVIATION = 7.5e-3  # m
BALL_DIAMETER = 15e-3  # m
CONTRAST = 0.0
# Places touched along a side: the paper's, where one layout is looked at; half of them in a study, which has many.
PLACES = 48
STUDY_PLACES = 24
# Least distance from the edge, where a touch is partly off the skin.
MARGIN = 10e-3  # m

# The mesh: 6 mm electrodes are 1.3 cells across, and the middle of the uppermost layer 0.5 mm below the surface.
CELL_SIZE = 4.5e-3  # m
NUM_LAYERS = 5

# Largest contrast of a touch: beyond it exact voltages are not found, and no longer change.
MOST_CONTRAST = 1e6

# Virtual taxels: number of clusters and cosine threshold of the paper.
NUM_TAXELS = 90
THRESHOLD = 0.7
# Prior correlation length of the amplitudes of touches: two deviations of the touch.
CORRELATION = 15e-3  # m
# Temperature of the smooth minimum of sensitivity.
TEMPERATURE = 0.1

# A search for a better layout: on a sheet of so many nodes, about, as each of its steps takes a gradient; and no closer
# than leaves 2 mm between electrodes 6 mm across.
NUM_POINTS = 1300
STEPS = 60
MINIMUM_SPACING = 8e-3  # m
