from .ellipsoid import KINDS, Ellipsoid, EllipsoidPrior
from .search import LEAST_RISE, ShapeReconstruction, reconstruct_shapes
from .star import Star, StarPrior

__all__ = [
    "KINDS",
    "LEAST_RISE",
    "Ellipsoid",
    "EllipsoidPrior",
    "ShapeReconstruction",
    "Star",
    "StarPrior",
    "reconstruct_shapes",
]
