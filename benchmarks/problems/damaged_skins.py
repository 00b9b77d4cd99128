"""Skins that are cut, lose electrodes and are repaired: simulated on fine meshes, monitored with models on coarse
meshes.

The simulated variation is that of the materials, fixed before any figure was computed. The load of a touch is a
trapezoid in time, with the fractions and durations below, at 5 frames per second. Parameters and limits are those of
Park et al. 2022, and jeit's requirements.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax
import numpy as np

from jeit.design.skin.names import skin_protocol
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import named_layout, ring
from jeit.mesh import Disk, Domain, Rectangle
from jeit.protocol import adjacent
from jeit.touch import CellFinder, SkinHealth, find_contacts
from jeit.touch.simulate import DiscIndenter, Press, PressDraws, PressedSkin, ball_indenter, material
from jeit.touch.simulate.damage import Cut, ElectrodeFault, draw_cut, mend_cut

RATE, DEFAULT_PATIENCE = 5.0, 30.0
# Fractions of the load during onset and release of a touch; median in seconds of the duration of a touch, and standard
# deviation of its logarithm; minimum and maximum pause between touches in seconds.
RISE, LASTS, BETWEEN = (0.25, 0.6, 1.0), (1.5, 0.5), (1.0, 8.0)
# Distance from a cut in metres beyond which touches must be located as accurately as before the cut.
APART = 0.025


@dataclass
class DamagedSkin:
    """A skin that is damaged. `name`: "park" (hydrogel, 32 inner electrodes, 94 pairs) or "round" (two films, 16
    electrodes, 208 channels); `seed` of all random draws; `nodes`: numbers of nodes for the simulation and for the
    images; `pool`: number of simulated touches.
    """

    name: str
    seed: int = 0
    nodes: tuple[int, int] = (2500, 1200)
    pool: int = 120

    @cached_property
    def material(self):
        return material("hydrogel" if self.name == "park" else "velostat")

    @cached_property
    def outline(self) -> Domain:
        return Rectangle(0.2, 0.2, (0.0, 0.0)) if self.name == "park" else Disk(0.05)

    @property
    def sheet(self) -> float:
        """Sheet conductance, siemens."""
        return self.material.conductivity * self.material.thickness

    @cached_property
    def scale(self) -> float:
        """Ratio of the lengths of this skin to those of the paper's skin."""
        return 1.0 if self.name == "park" else 0.5

    def model(self, nodes: int, cut: Cut | None = None) -> ForwardModel:
        """Forward model of the skin with about `nodes` nodes, refined along a cut."""
        mesh = self.outline.mesh(num_points=nodes, refine=None if cut is None else cut.refine(1e-3 * self.scale))
        if self.name == "park":
            layout = named_layout("park-inner")
            return ForwardModel(mesh, layout.sheet_discs(1e-4), skin_protocol(layout))
        electrodes = BoundaryElectrodes(ring(0.05, 16), 0.008, 0.006 / self.sheet)
        return ForwardModel(mesh, electrodes, adjacent(16))

    @cached_property
    def image_model(self) -> ForwardModel:
        return self.model(self.nodes[1])

    def whole(self, cut: Cut | None = None) -> PressedSkin:
        """The skin before it is cut, on the mesh that the cut needs."""
        return PressedSkin(self.key(0), self.model(self.nodes[0], cut), self.material)

    @cached_property
    def skin(self) -> PressedSkin:
        return self.whole()

    def key(self, number: int):
        return jax.random.fold_in(jax.random.key(self.seed), number)

    def presses(self, number: int, count: int) -> list[Press]:
        loads = (2.0, 10.0) if self.name == "park" else (0.5, 6.0)
        size = 0.02 * self.scale
        shapes = [ball_indenter(size), ball_indenter(1.5 * size), DiscIndenter(0.7 * size)]
        draws = PressDraws(shapes, self.outline, loads, margin=0.6 * size)
        return [one for (one,) in draws.draw(self.key(number), count)]

    @cached_property
    def touches(self) -> np.ndarray:
        """Voltage changes (pool, 3, channels) due to touches at the fractions `RISE` of their load."""
        return changes(self.skin, self.presses(1, self.pool))

    @cached_property
    def health(self) -> SkinHealth:
        """Monitor of the skin's health, learnt from two minutes of touches."""
        seconds = np.arange(0, 120, 1 / RATE)
        frames = self.read(self.skin, 2, seconds, self.touches)
        sign = -1 if self.name == "park" else 1
        options = {"model": self.image_model, "conductivity": self.sheet, "sign": sign, "patience": DEFAULT_PATIENCE}
        return SkinHealth.fit(frames, seconds, **options)

    def read(
        self, skin: PressedSkin, number: int, seconds: np.ndarray, touches, later=None, more: float | np.ndarray = 0.0
    ) -> np.ndarray:
        """Simulate frames (times, channels) of touches that are drawn from `touches` and follow each other.

        `later`: time, skin and touches; from this time on, frames are those of the other skin. `more` (times,
        channels): voltages in volts that are added to the frames.
        """
        random = np.random.default_rng([self.seed, number])
        change = [np.zeros((len(seconds), self.skin.gain.size)) for _ in range(2)]
        parts = [touches, touches if later is None else later[2]]
        start = random.uniform(*BETWEEN)
        while start < seconds[-1]:
            lasts = LASTS[0] * random.lognormal(0.0, LASTS[1])
            first, held = int(start * RATE), max(1, int(lasts * RATE) - 4)
            profile = np.concatenate([[0, 1], np.full(held, 2), [1, 0]]).astype(int)
            rows = np.arange(first, min(first + len(profile), len(seconds)))
            which = random.integers(len(touches))
            for out, some in zip(change, parts, strict=True):
                out[rows] += some[which % len(some), profile[: len(rows)]]
            start += lasts + random.uniform(*BETWEEN)
        # Voltages at rest are computed on the skin's own mesh, and the change by damage is added, because the
        # difference between two meshes is not damage.
        at_rest = self.at_rest(self.skin)
        rest = [at_rest, at_rest if later is None else at_rest + self.at_rest(later[1]) - self.at_rest(skin)]
        found = [
            self.skin.read(self.key(number), one + own + more, seconds) for one, own in zip(rest, change, strict=True)
        ]
        if later is None:
            return found[0]
        return np.where((seconds >= later[0])[:, None], found[1], found[0])

    @staticmethod
    def at_rest(skin: PressedSkin) -> np.ndarray:
        """Voltages (channels,) of an untouched skin without noise."""
        return np.asarray(skin.model.voltages(skin.conductivity))

    def cut(self, number: int, depth: float = 1.0) -> Cut:
        span = (0.02 * self.scale, 0.06 * self.scale)
        return draw_cut(self.key(number), self.outline, length=span, depth=depth, margin=4e-3 * self.scale)

    def damaged(self, cut: Cut) -> tuple[PressedSkin, PressedSkin, PressedSkin]:
        """The undamaged, the cut and the repaired skin, all on one mesh."""
        whole = self.whole(cut)
        mesh = whole.model.mesh
        torn = cut.conductivity(mesh, whole.conductivity, self.material.thickness)
        share = float(np.random.default_rng(int(1e6 * cut.length)).uniform(0.9, 1.1))
        glued, other = mend_cut(mesh, whole.conductivity, cut, self.material, share)
        return (
            whole,
            eqx.tree_at(lambda one: one.conductivity, whole, torn),
            eqx.tree_at(lambda one: (one.conductivity, one.material), whole, (glued, other)),
        )

    def fault(self, number: int, kind: str, seconds: np.ndarray, begins: float) -> tuple[int, np.ndarray]:
        """Draw an electrode; return its index, and the voltage changes (times, channels) due to a fault of the
        electrode that begins at `begins`."""
        electrode = int(np.random.default_rng([self.seed, number]).integers(self.skin.model.protocol.num_electrodes))
        there, more = seconds >= begins, np.zeros((len(seconds), self.skin.gain.size))
        fault = ElectrodeFault(electrode, kind)  # pyright: ignore[reportArgumentType]
        more[there] = fault.changes(self.key(number), self.skin.model, self.skin.conductivity, seconds[there])
        return electrode, more

    def off(self, health: SkinHealth, skin: PressedSkin, presses: list[Press], number: int) -> np.ndarray:
        """Errors of the located presses in metres, in images relative to a new reference; NaN for a press that is not
        detected."""
        rest = self.at_rest(skin)
        exact = rest + np.concatenate([np.zeros((10, 1, rest.size)), changes(skin, presses, (1.0,))])[:, 0]
        frames = self.skin.read(self.key(number), exact, np.array([20.0]))
        images = health.skin.images(frames[10:] - frames[:10].mean(axis=0), health.trusted)  # pyright: ignore
        finder = CellFinder(self.image_model.mesh, sign=health.skin.sign)  # pyright: ignore
        found = [find_contacts(finder, image) for image in images]
        return np.array(
            [
                np.linalg.norm(one[0].centroid - press.position) if one else np.nan
                for one, press in zip(found, presses, strict=True)
            ]
        )


def changes(skin: PressedSkin, presses: list[Press], shares: tuple[float, ...] = RISE) -> np.ndarray:
    """Voltage changes (presses, fractions, channels) in volts due to presses at the fractions `shares` of their load,
    each solved anew."""
    model, rest = skin.model, np.broadcast_to(skin.conductivity, skin.model.mesh.num_cells)
    parts = [Press(one.indenter, share * one.load, one.position, one.angle) for one in presses for share in shares]
    touched = skin.touched(parts, held=1.0)
    at_rest = np.asarray(model.voltages(rest))
    found = np.empty((len(parts), at_rest.size))
    for number, (cells, change) in enumerate(zip(np.asarray(touched.cells), np.asarray(touched.change), strict=True)):
        values = rest.copy()
        np.multiply.at(values, cells, 1 + change)
        found[number] = np.asarray(model.voltages(values)) - at_rest
    return found.reshape(len(presses), len(shares), -1)
