import numpy as np

from jeit.electrodes import BoundaryElectrodes
from jeit.layout import ring
from jeit.mesh import disk
from jeit.protocol import adjacent

mesh = disk(0.1, num_points=200)
electrodes = BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3)
