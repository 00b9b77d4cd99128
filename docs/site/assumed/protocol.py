import numpy as np

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import disk
from jeit.protocol import adjacent

electrodes = BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3)
model = ForwardModel(disk(0.1, num_points=200), electrodes, adjacent(16))
transfer = model.transfer_impedance(1.0)
