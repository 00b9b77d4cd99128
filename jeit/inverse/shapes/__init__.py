"""Bodies as shapes with few parameters: what is told of a body where voltages tell too little for an image."""

from __future__ import annotations

from jeit.inverse.shapes.ellipsoid import KINDS, Ellipsoid, EllipsoidPrior
from jeit.inverse.shapes.search import LEAST_RISE, ShapeReconstruction, reconstruct_shapes
from jeit.inverse.shapes.star import Star, StarPrior

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
