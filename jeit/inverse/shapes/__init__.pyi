from .bodies import Quantities
from .ellipsoid import KINDS, Ellipsoid, EllipsoidPrior
from .quantities import Accuracy
from .reconstruction import ShapeReconstruction
from .search import MIN_OBJECTIVE_RATIO, reconstruct_shapes
from .star import Star, StarPrior

__all__ = [
    "KINDS",
    "MIN_OBJECTIVE_RATIO",
    "Accuracy",
    "Ellipsoid",
    "EllipsoidPrior",
    "Quantities",
    "ShapeReconstruction",
    "Star",
    "StarPrior",
    "reconstruct_shapes",
]
