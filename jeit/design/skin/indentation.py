"""Indentations of a skin's surface by touches: depth as a function of the distance from the centre."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jeit.design.defaults import BALL_DIAMETER, DEPTH, DEVIATION
from jeit.mesh.outline.domain import check_length
from jeit_solvers.engines import either_engine, namespace


class AbstractIndentation(eqx.Module):
    """Base class of indentations. A new indentation is one subclass."""

    @abc.abstractmethod
    def depth_at(self, distance: Float[Array | np.ndarray, "..."]) -> Float[Array | np.ndarray, "..."]:
        """Depth in metres at horizontal distances (metres) from the centre."""

    @property
    @abc.abstractmethod
    def reach(self) -> float:
        """Distance in metres beyond which the depth is 0."""


class Bell(AbstractIndentation):
    """depth · exp(−r² / (2 deviation²)): by default the unit deformation of Park et al. 2022, text S4.

    Cut off at three deviations, where it is a hundredth of its depth.
    """

    depth: float
    deviation: float

    def __init__(self, depth: float = DEPTH, deviation: float = DEVIATION):
        """Both in metres."""
        self.depth = check_length("depth", depth)
        self.deviation = check_length("deviation", deviation)

    @either_engine
    def depth_at(self, distance):
        """Depth of the bell at distances (metres), metres."""
        xp = namespace(self, distance)
        distance = xp.asarray(distance)
        return xp.where(distance < self.reach, self.depth * xp.exp(-0.5 * (distance / self.deviation) ** 2), 0.0)

    @property
    def reach(self) -> float:
        """Three deviations."""
        return 3 * self.deviation


class Hemisphere(AbstractIndentation):
    """A rigid ball pressed in: depth − (R − √(R² − r²)) where that is positive; 15 mm across, as in the experiments."""

    depth: float
    diameter: float

    def __init__(self, depth: float = DEPTH, diameter: float = BALL_DIAMETER):
        """Both in metres. Raises `ValueError` for a ball pressed in beyond its middle."""
        self.depth = check_length("depth", depth)
        self.diameter = check_length("diameter", diameter)
        if self.depth > self.diameter / 2:
            raise ValueError(
                f"depth is {1e3 * self.depth:g} mm, but a hemisphere {1e3 * self.diameter:g} mm across goes in no "
                f"deeper than {5e2 * self.diameter:g} mm; give less depth, or a larger one."
            )

    @either_engine
    def depth_at(self, distance):
        """Depth of the ball at distances (metres), metres."""
        xp, radius = namespace(self, distance), self.diameter / 2
        height = xp.sqrt(xp.maximum(radius**2 - xp.asarray(distance) ** 2, 0.0))
        return xp.maximum(self.depth - radius + height, 0.0)

    @property
    def reach(self) -> float:
        """Radius of the cap's rim."""
        return float((self.depth * (self.diameter - self.depth)) ** 0.5)
