from .bending import bend, node_normals, surface_of
from .shells import shell
from .sleeves import forearm, tube
from .spheres import cap, sphere

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
