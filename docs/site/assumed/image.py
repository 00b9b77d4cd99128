import numpy as np

from jeit.image import Raster
from jeit.mesh import box, centroids, disk

mesh = disk(0.1, num_points=300)
image = np.exp(-np.sum((centroids(mesh) - np.array([0.04, 0.0])) ** 2, axis=1) / 0.02**2)
raster = Raster.create(mesh, shape=(64, 64))
solid = box(0.2, 0.1, 0.05, num_points=300)
solid_image = np.exp(-np.sum((centroids(solid) - np.array([0.0, 0.0, 0.03])) ** 2, axis=1) / 0.02**2)
times = np.arange(40) / 10
changes = np.outer(1 + 0.5 * np.sin(2 * np.pi * times), image)
