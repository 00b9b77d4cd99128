"""The camera and the light of a picture in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jeit.arguments import describe, is_number

# Direction of the light, from over the viewer's left shoulder: to the right and up on the page, and towards the viewer.
_LIGHT = np.array([-0.35, 0.5, 0.79])
_DARKEST = 0.66


@dataclass(frozen=True)
class Camera:
    """A direction to look from, far away, so that lengths across it are true and one scale bar is right everywhere.

    **Fields**: `azimuth`, degrees round z from the x axis towards y, where the viewer stands; `elevation`, degrees
    above the plane z = 0. −90 and 0 look at the front, along y; elevation 90 looks down. Raises `ValueError` for what
    is no angle, and an elevation beyond 90 degrees.
    """

    azimuth: float = -60.0
    elevation: float = 25.0

    def __post_init__(self):
        for name, value in (("azimuth", self.azimuth), ("elevation", self.elevation)):
            if not is_number(value):
                raise ValueError(f"{name} must be an angle in degrees; it is {describe(value)}.")
        if not -90 <= self.elevation <= 90:
            raise ValueError(f"elevation must lie between −90 (from below) and 90 degrees; it is {self.elevation:g}.")

    @property
    def toward(self) -> Float[np.ndarray, "3"]:
        """The direction to the viewer."""
        round_z, above = np.radians(self.azimuth), np.radians(self.elevation)
        return np.array([np.cos(above) * np.cos(round_z), np.cos(above) * np.sin(round_z), np.sin(above)])

    @property
    def right(self) -> Float[np.ndarray, "3"]:
        """The direction to the right on the page."""
        round_z = np.radians(self.azimuth)
        return np.array([-np.sin(round_z), np.cos(round_z), 0.0])

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """The direction up the page."""
        return np.cross(self.toward, self.right)

    def on_page(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Places (…, 3) as seen, metres to the right and up."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)

    def nearness(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """Coordinate of places (…, 3) towards the viewer, metres."""
        return points @ self.toward

    def light(self, normals: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
        """Brightness (m,), from dark to 1, of surfaces with these normals (any length), lit from both sides alike."""
        length = np.maximum(np.linalg.norm(normals, axis=-1), 1e-300)
        direction = normals / length[:, None]
        direction = direction * np.where(direction @ self.toward < 0, -1.0, 1.0)[:, None]
        lamp = _LIGHT[0] * self.right + _LIGHT[1] * self.up + _LIGHT[2] * self.toward
        return _DARKEST + (1 - _DARKEST) * np.clip(direction @ lamp / np.linalg.norm(lamp), 0, 1)


FROM_THE_CORNER = Camera()
