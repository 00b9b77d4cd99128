from .bending import bend
from .boundary import surface_of
from .shells import shell
from .sleeves import forearm, tube
from .spheres import cap, sphere
from .vertex_normals import node_normals

__all__ = [
    "bend",
    "cap",
    "forearm",
    "node_normals",
    "shell",
    "sphere",
    "surface_of",
    "tube",
]
