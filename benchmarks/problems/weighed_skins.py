"""Skins of 200 mm under weights, after Pugach et al. 2015: a disk and a square of one film, 16 electrodes on the edge.

The simulated variation is that of the material, fixed before any accuracy was computed. A weight stands on a disc of
16.25 mm, which is the size that the paper specifies. Positions are anywhere on the skin where the disc does not extend
beyond the edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import perimeter
from jeit.mesh import Disk, Domain, Rectangle
from jeit.protocol import adjacent
from jeit.touch.simulate import DiscIndenter, Press, PressDraws, PressedSkin, material

RADIUS, DISC, CURRENT, GRAVITY = 0.1, 16.25e-3, 200e-6, 9.81e-3
GRAMS = 100.0
OUTLINES: dict[str, Domain] = {"disk": Disk(RADIUS), "square": Rectangle(2 * RADIUS, 2 * RADIUS)}


@dataclass
class WeighedSkin:
    """A skin with the outline `name` ("disk" or "square"), simulated with `nodes` nodes."""

    name: str = "disk"
    nodes: int = 4000

    def model(self, nodes: int) -> ForwardModel:
        """Forward model of the skin, on a mesh with `nodes` nodes."""
        outline, own = OUTLINES[self.name], material("velostat")
        places = perimeter(outline, 16, start=outline.perimeter / 32)
        electrodes = BoundaryElectrodes(places, 0.01, 1e-3 / (own.conductivity * own.thickness))
        return ForwardModel(outline.mesh(num_points=nodes), electrodes, adjacent(16, current=CURRENT))

    @cached_property
    def skin(self) -> PressedSkin:
        """The skin that is pressed."""
        return PressedSkin(jax.random.key(0), self.model(self.nodes), material("velostat"))

    def presses(self, seed: int, number: int, grams: float = GRAMS) -> tuple[np.ndarray, np.ndarray]:
        """Frames (number, 208) of the skin under one weight, and positions (number, 2) of the weight in metres."""
        load = grams * GRAVITY
        draws = PressDraws([DiscIndenter(DISC)], OUTLINES[self.name], (load, load), margin=DISC / 2)
        drawn = draws.draw(jax.random.key(seed), number)
        places = np.array([one[0].position for one in drawn])
        return self.skin.frames(jax.random.key(seed + 1), drawn), places

    def several(self, seed: int, number: int, grams: tuple[float, ...], apart: float):
        """Frames (number, 208) of the skin under k weights at once, and positions (number, k, 2) of the weights, at
        least `apart` metres from each other."""
        random = np.random.default_rng(seed)
        inside, places = OUTLINES[self.name].signed_distance, []
        while len(places) < number:
            tried = random.uniform(-RADIUS, RADIUS, (len(grams), 2))
            off = np.linalg.norm(tried[:, None] - tried, axis=-1) + RADIUS * 10 * np.eye(len(grams))
            if (np.asarray(inside(tried)) > 0.015).all() and off.min() > apart:
                places.append(tried)
        touches = [
            tuple(Press(DiscIndenter(DISC), one * GRAVITY, place) for one, place in zip(grams, some, strict=True))
            for some in places
        ]
        return self.skin.frames(jax.random.key(seed + 1), touches), np.array(places)
