"""Indenters moved and turned in their frame, and several joined to one rigid body."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jeit.arguments import is_number, real_array
from jeit.touch.simulate.contact.indenters import AbstractIndenter, check_indenter


class Placed(AbstractIndenter):
    """An `indenter` turned by `angle` radians, counter-clockwise, then moved to `position` (x, y), metres."""

    indenter: AbstractIndenter
    position: Float[np.ndarray, "2"]
    angle: float

    def __init__(self, indenter: AbstractIndenter, position: ArrayLike = (0.0, 0.0), angle: float = 0.0):
        """Raises `ValueError` for what is no indenter, place or angle."""
        check_indenter("indenter", indenter)
        self.indenter, self.position, self.angle = indenter, check_position(position), check_angle(angle)

    def gap(self, points):
        """The indenter's, at the points as they lie in its frame."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return self.indenter.gap((np.asarray(points) - self.position) @ np.array([[cos, -sin], [sin, cos]]))

    @property
    def reach(self) -> float:
        """The indenter's, and how far it was moved."""
        return float(np.hypot(*self.position) + self.indenter.reach)


class Joined(AbstractIndenter):
    """Several `parts`, one rigid body under one load: their lowest points are level. Mostly `Placed` ones."""

    parts: tuple[AbstractIndenter, ...]

    def __init__(self, *parts: AbstractIndenter):
        """Raises `ValueError` for no parts, and for what is no indenter."""
        if not parts:
            raise ValueError(
                "parts: give one indenter at least, such as Joined(Disc(0.01), Placed(Disc(0.01), (0.02, 0)))"
            )
        for number, part in enumerate(parts):
            check_indenter(f"part {number}", part)
        self.parts = parts

    def gap(self, points):
        """The least of the parts'."""
        return np.min([part.gap(points) for part in self.parts], axis=0)

    @property
    def reach(self) -> float:
        """The farthest of the parts'."""
        return max(part.reach for part in self.parts)


def check_position(position, *, in_space: bool = False) -> Float[np.ndarray, " d"]:
    """A place (x, y) in metres as an array, or where it may be `in_space` (x, y, z). Raises `ValueError` for what is
    none."""
    where = real_array("position", position, "(x, y) in metres")
    if where.shape not in ((2,), (3,))[: 1 + in_space] or not np.isfinite(where).all():
        raise ValueError(f"position: give (x, y) in metres, not {position!r}.")
    return where


def check_angle(angle) -> float:
    """An angle in radians. Raises `ValueError` for what is none."""
    if not is_number(angle):
        raise ValueError(f"angle: give radians, not {angle!r}.")
    return float(angle)
