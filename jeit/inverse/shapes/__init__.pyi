from .bodies import Quantities
from .ellipsoid import KINDS, Ellipsoid, EllipsoidPrior
from .quantities import Accuracy
from .reconstruction import ShapeReconstruction
from .search import LEAST_RISE, reconstruct_shapes
from .star import Star, StarPrior

__all__ = [
    "KINDS",
    "LEAST_RISE",
    "Accuracy",
    "Ellipsoid",
    "EllipsoidPrior",
    "Quantities",
    "ShapeReconstruction",
    "Star",
    "StarPrior",
    "reconstruct_shapes",
]
