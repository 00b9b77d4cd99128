"""A fabric whose squares are pressed one at a time, simulated after Russo et al. (2017).

The fabric is a square with electrodes along its edge and opposite drives. A finger presses the squares of a chess board
in the middle of the fabric with 10 to 100 kPa, within 1 mm of their centres. The training data are six repetitions of
twenty presses of each square, ten minutes apart, read as medians of 160 samples. The test data are twenty presses of
each square a day later, four for each of five random drifts over a day, either with the old reference or with a
reference of one scan that is renewed up to ten minutes before. Drift and noise are those of the material.

**Bent** round a cylinder along y, the sheet conducts as before, with two exceptions. First, the conductor lies half of
the sensor's 1.5 mm outside the neutral layer: at a radius R it is stretched by 0.75 mm / R round the bend, and its
resistance in that direction grows 5 times as much (an assumed gauge factor). Second, a flat finger touches the ridge
first: the gap between finger and fabric is x² / 2R.

All parameters were fixed before accuracies were computed, except the number of days: with a single day, the random
drift of this day determined the result.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, Int

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import perimeter
from jeit.mesh import Rectangle
from jeit.protocol import opposite
from jeit.touch.simulate import DiscIndenter, Press, PressedSkin, material
from jeit.touch.simulate.contact.indenters import AbstractIndenter

REPETITIONS, PRESSES, TESTS, DAYS = 6, 20, 20, 5
SAMPLES, SCAN = 160, 3200  # of a median, and of a scan
MINUTES, DAY = 10.0, 86400.0  # between repetitions; and to the test, seconds
PRESSURE, JITTER, CONTACT = (10e3, 100e3), 1e-3, 0.6  # Pa; m; of a finger's width, beside the target's
OUTSIDE, GAUGE = 0.75e-3, 5.0  # of the layer that keeps its length, m; relative change over strain
SQUARES = {0.015: (7, 7), 0.010: (10, 10)}


class OnCylinder(AbstractIndenter):
    """An `indenter` on a skin that is bent to `radius`, metres, round a cylinder along y."""

    indenter: AbstractIndenter
    radius: float

    def gap(self, points):
        """Gap between the bent skin and the indenter in metres: the gap to a flat skin plus x² / 2R."""
        return self.indenter.gap(points) + np.asarray(points)[..., 0] ** 2 / (2 * self.radius)

    @property
    def reach(self) -> float:
        """Reach of the indenter in metres."""
        return self.indenter.reach


class Fabric:
    """Readings of presses on C squares of width `target` (metres) on a fabric of `side` metres with a number of
    `electrodes`.

    `squares`: numbers of squares along x and y. `bend`: radius in metres of a cylinder round which the fabric is bent.
    All readings are changes in volts of M voltages from the initial voltages of the untouched fabric, without noise;
    the standard deviation of noise is `noise`. `features` (T, C + 1, P, M): T repetitions of P presses of each square,
    the last class untouched. `tests` (C + 1, P, M): presses a day later, one day after the other. `middles` (C, 2) and
    `places` (L, 2): centres of squares and of electrodes in metres.
    """

    def __init__(
        self,
        electrodes: int = 16,
        side: float = 0.13,
        target: float = 0.015,
        *,
        presses: int = PRESSES,
        nodes: int = 2000,
        squares: tuple[int, int] | None = None,
        bend: float = np.inf,
    ):
        outline = Rectangle(side, side)
        self.places = perimeter(outline, electrodes, start=side / (electrodes // 4) / 2)
        contacts = BoundaryElectrodes(self.places, 0.4 * 4 * side / electrodes, 1e-2)
        mesh = outline.mesh(num_points=nodes)
        # The paper has 96 voltages with 16 electrodes (distinct drives), and 32 voltages with 8 electrodes (all
        # drives).
        model = ForwardModel(mesh, contacts, opposite(electrodes, drives="all" if electrodes == 8 else "distinct"))
        own = material("conductive fabric")
        stretched = np.diag([1 / (1 + GAUGE * OUTSIDE / bend), 1.0])
        conductivity = np.broadcast_to(own.conductivity * own.thickness * stretched, (mesh.num_cells, 2, 2))
        self._skin = PressedSkin(jax.random.key(0), model, replace(own, noise=0.0), conductivity=conductivity)
        self._rest = self._skin.rest()
        # The noise of medians of samples is larger than that of means by a quarter.
        self.noise = own.noise * float(np.sqrt(np.mean(self._rest**2))) * 1.25 / np.sqrt(SAMPLES)
        x, y = ((np.arange(count) - (count - 1) / 2) * target for count in squares or SQUARES[target])
        self.middles = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        finger: AbstractIndenter = DiscIndenter(CONTACT * target)
        if np.isfinite(bend):
            finger = OnCylinder(finger, bend)
        rng = np.random.default_rng(0)

        def read(key: int, number: int, elapsed: float) -> np.ndarray:
            drawn = [_press(rng, finger, middle) for middle in self.middles for _ in range(number)]
            frames = self._changes(key, [*drawn, *[()] * number], elapsed)
            return frames.reshape(len(self.middles) + 1, number, -1)

        self.features = np.stack([read(one, presses, 60 * MINUTES * one) for one in range(REPETITIONS)])
        days = [read(REPETITIONS + one, TESTS // DAYS, DAY) for one in range(DAYS)]
        self.tests = np.concatenate(days, axis=1)
        self._later = self._drifts(TESTS)

    def observations(
        self, number: int, *, untouched: bool = False
    ) -> tuple[Float[np.ndarray, "N M"], Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
        """About `number` training observations per class, with noise, and their classes and repetitions. If
        `untouched`, the untouched fabric is included as class C."""
        features = self.features if untouched else self.features[:, :-1]
        repetitions, classes, presses, channels = features.shape
        own = min(presses, max(1, number // repetitions))
        medians = max(1, number // (repetitions * own))
        exact = np.repeat(features[:, :, :own], medians, axis=2).reshape(-1, channels)
        label = np.tile(np.repeat(np.arange(classes), own * medians), repetitions)
        return self._noisy(exact, 1), label, np.repeat(np.arange(repetitions), classes * own * medians)

    def asked(self, *, anew: bool) -> Float[np.ndarray, "C P M"]:
        """Readings of presses a day later, with noise; if `anew`, with a reference that is renewed up to ten minutes
        before."""
        if not anew:
            return self._noisy(self.tests[:-1], 2)
        return self._noisy(self.tests[:-1] - self.tests[-1] + self._later, 2) - self._reference()

    def untouched(self, number: int, each: int, *, anew: bool) -> Float[np.ndarray, "n M"]:
        """Readings of the untouched fabric a day later: `each` frames after each of `number` random drifts or, unless
        `anew`, after the drifts of the tests in turn.

        Noise is added, and the reference is renewed if `anew`, as in `asked`.
        """
        if not anew:
            return self._noisy(np.repeat(np.resize(self.tests[-1], (number, self._rest.size)), each, axis=0), 3)
        return self._noisy(np.repeat(self._drifts(number), each, axis=0), 3) - self._reference()

    @property
    def distance(self) -> Float[np.ndarray, " C"]:
        """Distance of each square's centre from the centre of the nearest electrode, metres."""
        return np.linalg.norm(self.middles[:, None] - self.places, axis=-1).min(axis=1)

    def _drifts(self, number: int) -> Float[np.ndarray, "n M"]:
        """Drift of the untouched fabric's voltages from the initial voltages, within ten minutes of a renewed
        reference, in volts."""
        seconds = np.random.default_rng(4).uniform(0, 60 * MINUTES, number)
        return np.concatenate([self._changes(int(DAY) + one, [()], each) for one, each in enumerate(seconds, start=1)])

    def _changes(self, key: int, presses: list, elapsed: float) -> Float[np.ndarray, "n M"]:
        return self._skin.frames(jax.random.key(key), presses, elapsed=float(elapsed)) - self._rest

    def _noisy(self, exact: np.ndarray, seed: int) -> np.ndarray:
        return exact + self.noise * np.random.default_rng(seed).normal(size=exact.shape)

    def _reference(self) -> Float[np.ndarray, " M"]:
        """Random noise of a reference in volts, which is the mean of the medians of a scan."""
        return self.noise * np.random.default_rng(5).normal(size=self.tests.shape[-1]) / np.sqrt(SCAN / SAMPLES)


def _press(rng: np.random.Generator, finger: AbstractIndenter, middle: np.ndarray) -> Press:
    pressure = np.exp(rng.uniform(*np.log(PRESSURE)))
    return Press(finger, pressure * np.pi * finger.reach**2, middle + rng.uniform(-JITTER, JITTER, 2))
