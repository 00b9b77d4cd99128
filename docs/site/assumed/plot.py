import numpy as np

from jeit.electrodes import BoundaryElectrodes, plates
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import box, centroids, disk
from jeit.protocol import adjacent

mesh = disk(0.1, num_points=200)
electrodes = BoundaryElectrodes(ring(0.1, 16), 0.01, 1e-3)
model = ForwardModel(mesh, electrodes, adjacent(16))
image = np.exp(-np.sum((centroids(mesh) - np.array([0.04, 0.0])) ** 2, axis=1) / 0.02**2)
change = model.voltages(1.0 + image) - model.voltages(1.0)
solid = box(0.2, 0.1, 0.05, num_points=300)
solid_image = np.exp(-np.sum((centroids(solid) - np.array([0.0, 0.0, 0.03])) ** 2, axis=1) / 0.03**2)
ends = plates(solid, ["left", "right"], 1e-3)
