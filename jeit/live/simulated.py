"""Simulated sources, which need no device: a tank in which a rod goes round, and a skin that is stroked."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jeit.arguments import check_name
from jeit.data import Measurement, RoundSkin, screen
from jeit.live.pictures import LiveFrame
from jeit.live.sources import ENDED, AbstractSource
from jeit.mesh import Disk, centroids

# Frames of the reference.
_STILL = 50
_KINDS = ("tank", "skin")


class SimulatedTank(AbstractSource):
    """A round tank, a sheet 200 mm across with 16 electrodes, in which an insulating rod goes round.

    The rod, 12 mm in radius, is at radius 50 mm and needs `period` seconds for a turn, anticlockwise from the x axis.
    Frames (208,) of the adjacent protocol have Gaussian noise, relative to their root mean square; `seed` is of its
    generator. `truth` is where the rod is, and `reference` a measurement of the tank without it.
    """

    radius, rod, orbit = 0.1, 0.012, 0.05

    def __init__(self, rate: float = 60.0, *, period: float = 8.0, noise: float = 1e-4, seed: int = 0, limit=None):
        """`limit`: number of frames after which the source ends; default: none."""
        super().__init__("demo: a tank in which a rod goes round")
        self.rate, self.period, self.limit = float(rate), float(period), limit
        skin = RoundSkin(
            radius=self.radius,
            electrode_width=0.02,
            contact_impedance=1e-3,
            conductivity=0.01,
            num_points=2500,
        )
        model = skin.model()
        places = centroids(model.mesh)

        def voltages(x: float, y: float) -> np.ndarray:
            near = (np.asarray(places[:, 0]) - x) ** 2 + (np.asarray(places[:, 1]) - y) ** 2 < self.rod**2
            return np.asarray(model.voltages(skin.conductivity * np.where(near, 0.05, 1.0)))

        rest = np.asarray(model.voltages(np.full(model.mesh.num_cells, skin.conductivity)))
        count = model.protocol.num_electrodes
        # A turn by the pitch of the electrodes permutes the channels: positions on one pitch give all others.
        self.steps = max(1, min(60, round(self.rate * self.period / count)))
        angles = 2 * np.pi / count * np.arange(self.steps) / self.steps
        first = np.stack([voltages(*(self.orbit * np.array([np.cos(a), np.sin(a)]))) for a in angles]) - rest
        turned = first.reshape(self.steps, count, -1)
        # Electrodes follow each other clockwise, and the rod goes round anticlockwise.
        around = np.stack([np.roll(turned, -k, axis=1) for k in range(count)])
        self.still = rest
        self.frames = rest + around.reshape(count * self.steps, -1)
        self.noise = noise * np.sqrt(np.mean(rest**2))
        self.random = np.random.default_rng(seed)
        self.reference = _reference(skin, model, rest, self.noise, self.random, "simulated tank")

    def truth(self, second: float) -> tuple[float, float]:
        """Place (x, y) of the rod in the frame that arrives at a time, metres."""
        angle = 2 * np.pi * self._position(second) / len(self.frames)
        return self.orbit * float(np.cos(angle)), self.orbit * float(np.sin(angle))

    def _position(self, second: float) -> int:
        return int(second / self.period * len(self.frames)) % len(self.frames)

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        number = 0
        while (self.limit is None or number < self.limit) and not self.closing.wait(
            max(0.0, self.begun + number / self.rate - time.monotonic())
        ):
            arrived = time.monotonic()
            values = self.frames[self._position(arrived - self.begun)]
            yield self.frame(values + self.noise * self.random.standard_normal(values.shape), arrived)
            number += 1
        self.connection = ENDED


def simulated(text: str, rate: float | None = None) -> AbstractSource:
    """The simulated source that "demo", "demo:tank" or "demo:skin" names. Raises `ValueError` for another name."""
    kind = text.partition(":")[2] or "tank"
    check_name("demo", kind, _KINDS)
    return SimulatedTank(60.0 if rate is None else rate)


def _reference(skin: RoundSkin, model, rest: Float[np.ndarray, " M"], noise: float, random, name: str) -> Measurement:
    return screen(
        rest + noise * random.standard_normal((_STILL, len(rest))),
        model.protocol,
        electrodes=model.electrodes,
        domain=Disk(skin.radius),
        name=name,
        source="simulated",
        notes=("simulated, not measured.",),
    )
