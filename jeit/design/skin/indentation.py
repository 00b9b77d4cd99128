"""Indentation of a skin by a touch: depth as a function of the distance from the centre."""

from __future__ import annotations

import abc

import numpy as np
from jaxtyping import Array, Float

from jeit.design.defaults import BALL_DIAMETER, DEPTH, DEVIATION
from jeit.mesh.outline.domain import check_length
from jeit_solvers.engines import either_engine, namespace
from jeit_solvers.module import Module


class AbstractIndentation(Module):
    """Base class of indentations of a skin; a new indentation is a subclass."""

    @abc.abstractmethod
    def depth_at(self, distance: Float[Array | np.ndarray, "..."]) -> Float[Array | np.ndarray, "..."]:
        """Depth in metres at horizontal distances (metres) from the centre."""

    @property
    @abc.abstractmethod
    def reach(self) -> float:
        """Distance in metres from the centre beyond which the depth is 0."""


class Bell(AbstractIndentation):
    """Gaussian indentation depth · exp(−r² / (2 deviation²)) at distance r; with the default values, the unit
    deformation of Park et al. 2022, text S4.

    The indentation is set to 0 beyond r = 3 deviation, where the depth has dropped to about a hundredth of `depth`.

    **Fields**: `depth`: largest depth, metres; `deviation`: standard deviation of the Gaussian, metres.

    **Example:**

    ```python
    touched = skin.touched_cells([(0.0, 0.0)], Bell(depth=2e-3, deviation=6e-3))
    changes = skin.voltage_changes(touched)
    ```
    """

    depth: float
    deviation: float

    def __init__(self, depth: float = DEPTH, deviation: float = DEVIATION):
        """`depth`: maximum depth, metres; `deviation`: standard deviation of the Gaussian, metres."""
        self.depth = check_length("depth", depth)
        self.deviation = check_length("deviation", deviation)

    @either_engine
    def depth_at(self, distance):
        """Depth in metres at horizontal distances (metres) from the centre."""
        xp = namespace(self, distance)
        distance = xp.asarray(distance)
        return xp.where(distance < self.reach, self.depth * xp.exp(-0.5 * (distance / self.deviation) ** 2), 0.0)

    @property
    def reach(self) -> float:
        """Distance from the centre beyond which the depth is 0: three times the standard deviation, metres."""
        return 3 * self.deviation


class Hemisphere(AbstractIndentation):
    """Indentation by a rigid ball of radius R: depth − (R − √(R² − r²)) at distance r where this difference is
    positive, otherwise 0.

    The default diameter is that of the ball in the experiments of Park et al. 2022.

    **Fields**: `depth`: depth of the lowest point, metres; `diameter`: diameter 2R of the ball, metres.

    **Example:**

    ```python
    touched = skin.touched_cells([(0.0, 0.0)], Hemisphere(depth=2e-3, diameter=0.01))
    changes = skin.voltage_changes(touched)
    ```
    """

    depth: float
    diameter: float

    def __init__(self, depth: float = DEPTH, diameter: float = BALL_DIAMETER):
        """`depth`: maximum depth, metres; `diameter`: diameter of the ball, metres. Raises `ValueError` for a depth
        greater than the radius of the ball."""
        self.depth = check_length("depth", depth)
        self.diameter = check_length("diameter", diameter)
        if self.depth > self.diameter / 2:
            raise ValueError(
                f"depth is {1e3 * self.depth:g} mm, but a hemisphere {1e3 * self.diameter:g} mm across goes in no "
                f"deeper than {5e2 * self.diameter:g} mm; give less depth, or a larger one."
            )

    @either_engine
    def depth_at(self, distance):
        """Depth in metres at horizontal distances (metres) from the centre of the ball."""
        xp, radius = namespace(self, distance), self.diameter / 2
        height = xp.sqrt(xp.maximum(radius**2 - xp.asarray(distance) ** 2, 0.0))
        return xp.maximum(self.depth - radius + height, 0.0)

    @property
    def reach(self) -> float:
        """Distance from the centre beyond which the depth is 0: the radius of the contact area, metres."""
        return float((self.depth * (self.diameter - self.depth)) ** 0.5)
