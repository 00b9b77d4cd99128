from .shells import bend, node_normals, shell, surface_of
from .sleeves import cap, forearm, sphere, tube

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
