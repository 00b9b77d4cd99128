from .geodesics import Geodesics
from .triangles import SurfacePlaces, Triangles
from .unfolding import Unfolding, unfold
from .unrolled_surface import Unrolled, unroll

__all__ = [
    "Geodesics",
    "SurfacePlaces",
    "Triangles",
    "Unfolding",
    "Unrolled",
    "unfold",
    "unroll",
]
