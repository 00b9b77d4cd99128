import functools

import numpy as np

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import centroids, disk
from jeit.protocol import adjacent

mesh = disk(0.1, num_points=200)
model = ForwardModel(mesh, BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3), adjacent(16))
inside = np.linalg.norm(centroids(mesh) - np.array([0.04, 0.0]), axis=1) < 0.03
reference = model.voltages(1.0)
voltages = model.voltages(np.where(inside, 2.0, 1.0))
change = voltages - reference
