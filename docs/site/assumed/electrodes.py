import numpy as np

from jeit.layout import ring
from jeit.mesh import box, cylinder, disk, rectangle, tube

mesh = disk(0.1, num_points=200)
sheet = rectangle(0.2, 0.1, num_points=500)
solid = box(0.2, 0.1, 0.05, num_points=500)
sleeve = tube(0.04, 0.1, num_points=500)
tank = cylinder(0.1, 0.1, num_points=500)
