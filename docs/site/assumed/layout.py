from jeit.mesh import Disk, Rectangle, tube

sleeve = tube(0.04, 0.1, num_points=300)
