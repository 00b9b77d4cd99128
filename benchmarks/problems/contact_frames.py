"""Frames of a pressed skin of 100 mm after Chen et al. 2022, simulated on a finer mesh than that of the images.

The simulated variation is that of the material, fixed before any accuracy was computed: noise, gains, and drift over up
to twenty seconds from the time at which the skin equals its model. Contact finders receive the noise of untouched
frames over the same time. The conductance of one layer along the sheet changes by a hundredth of the change of two
layers (an assumption: no figure is published).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import back_projection, one_step
from jeit.inverse.linear.one_step import LinearReconstruction
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch.contacts import ImageNoise
from jeit.touch.simulate import DiscIndenter, Press, PressDraws, PressedSkin, ball_indenter, material

RADIUS, GRAVITY, SECONDS = 0.05, 9.81, 20.0
SINGLE = 0.01
LOADS = {"velostat": (0.5, 10.0), "conductive fabric": (0.3, 2.5)}
# Least distance in metres between simultaneous touches, at which two touches can still be distinguished, and margin to
# the edge.
APART, MARGIN = 0.022, 0.008


@dataclass
class ContactFrames:
    """Frames of a skin of the material `name`, whose noise and saturated change are those of the material times `noise`
    and `saturation`, and images of the frames. `nodes`: numbers of nodes for the simulation and for the images.
    """

    name: str = "velostat"
    noise: float = 1.0
    saturation: float = 1.0
    nodes: tuple[int, int] = (4000, 1000)
    seed: int = 0

    @cached_property
    def models(self) -> list[ForwardModel]:
        """The forward models of the skin and of the images."""
        own = material(self.name)
        electrodes = BoundaryElectrodes(ring(RADIUS, 16), 0.008, 0.006 / (own.conductivity * own.thickness))
        return [ForwardModel(Disk(RADIUS).mesh(num_points=n), electrodes, adjacent(16)) for n in self.nodes]

    @cached_property
    def skin(self) -> PressedSkin:
        """The skin that is pressed."""
        own = material(self.name)
        changed = {"noise": self.noise * own.noise, "saturation": self.saturation * own.saturation}
        return PressedSkin(self._key(0), self.models[0], dataclasses.replace(own, **changed))

    @cached_property
    def before(self) -> np.ndarray:
        """A hundred frames (100, 208) of the untouched skin over twenty seconds, in volts."""
        return self.empty(1, 100)

    def empty(self, key: int, number: int) -> np.ndarray:
        """Frames (number, 208) of the untouched skin in volts, five for every random drift."""
        return self.frames(10_000 * key, [()] * number, at_once=5)

    def frames(self, key: int, presses: list, at_once: int = 1) -> np.ndarray:
        """Frames (n, 208) of presses in volts. `at_once` successive frames share one random drift."""
        parts = [presses[first : first + at_once] for first in range(0, len(presses), at_once)]
        times = np.random.default_rng(key).uniform(0, SECONDS, len(parts))
        read = [
            self.skin.frames(self._key(key + 1 + number), part, elapsed=float(elapsed))
            for number, (part, elapsed) in enumerate(zip(parts, times, strict=True))
        ]
        return np.concatenate(read)

    def reconstruction(self, method: str) -> LinearReconstruction:
        """The linear reconstruction by `method`, "one-step" or "back-projection"."""
        conductivity = float(self.skin.conductivity[0])
        if method == "back-projection":
            return back_projection(self.models[1], conductivity)
        return one_step(self.models[1], conductivity, noise=self.before.std(axis=0))

    def images(self, reconstruction: LinearReconstruction, frames: np.ndarray) -> np.ndarray:
        """Images (frames, cells) of the conductivity change from the mean of the untouched frames, in S."""
        return np.asarray(reconstruction.image(frames - self.before.mean(axis=0)))

    def image_noise(self, reconstruction: LinearReconstruction) -> ImageNoise:
        """The noise of images of untouched frames."""
        return ImageNoise.of_frames(reconstruction, self.before)

    def touches(self, key: int, number: int) -> list[tuple[Press, ...]]:
        """Draw one to three simultaneous discs and balls of many sizes, loads and positions, far enough apart to be
        distinguished.
        """
        shapes = [
            DiscIndenter(0.006),
            DiscIndenter(0.008),
            DiscIndenter(0.0115),
            ball_indenter(0.02),
            ball_indenter(0.03),
        ]
        draws = PressDraws(shapes, Disk(RADIUS), LOADS[self.name], margin=MARGIN, at_once=3)
        drawn = draws.draw(self._key(key), number)
        return [one for one in drawn if np.min(_distances(one), initial=1.0) > APART]

    def _key(self, number: int):
        return jax.random.fold_in(jax.random.key(self.seed), number)


def weight(grams: float, place, radius: float = 0.0115) -> Press:
    """Press of a weight that stands on a flat disc of the given `radius` at `place`, in metres."""
    return Press(DiscIndenter(2 * radius), 1e-3 * grams * GRAVITY, place)


def _distances(touch: tuple[Press, ...]) -> list[float]:
    places = [press.position for press in touch]
    return [float(np.linalg.norm(a - b)) for k, a in enumerate(places) for b in places[:k]]
