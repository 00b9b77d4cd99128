"""Touches for the evaluation of imaging networks, simulated on a finer mesh, with electrodes and contacts that deviate
from the description.

The simulated variation was fixed before any figure was computed: contact impedances ±10 %, electrode positions ±0.5 mm
(uniform), noise for a limit of detection of 0.7 N.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jeit.design import Skin, touches_away_from_the_edge
from jeit.layout import Layout, named_layout
from jeit.touch.simulate import (
    BarIndenter,
    DepthMapIndenter,
    DiscIndenter,
    Indent,
    JoinedIndenters,
    PlacedIndenter,
    RingIndenter,
    ball_indenter,
    relative_changes,
)
from jeit.touch.simulate.contact.indents import relative_voltage_changes

CELL, SKINS = 3e-3, 5
TIP, TIP_DEPTH, PLACES = 0.015, 7.5e-3, 15
APART = 0.041


@dataclass(frozen=True)
class Wrong:
    """Deviations of a simulated skin from the description that networks use: half widths of uniform distributions.

    `contact`: of logarithms of contact impedances; `place`: of electrode positions, in metres; `drift`: of logarithms
    of contact impedances, after the reference.
    """

    contact: float = 0.1
    place: float = 0.5e-3
    drift: float = 0.0


def park_skin(cell: float | None = None) -> Skin:
    """The skin of Park et al., 200 × 200 × 10 mm of hydrogel with 32 inner electrodes and 94 pairs, as a sheet with
    cells of size `cell` metres."""
    return Skin.create(named_layout("park-inner"), num_layers=0, cell_size=cell)


class JudgedSkins:
    """Skins with different deviations from their description. Successive touches are measured by the skins in turn."""

    def __init__(self, wrong: Wrong | None = None, *, seed: int = 77, skins: int = SKINS, cell: float = CELL):
        wrong = Wrong() if wrong is None else wrong
        random = np.random.default_rng(seed)
        plain = park_skin(cell)
        layout = plain.layout
        own = np.full(layout.num_electrodes, 1e-4)
        self.plain, self.skins, self.drifts = plain, [], []
        for _ in range(skins):
            centres = np.asarray(layout.centres) + random.uniform(-wrong.place, wrong.place, (len(own), 2))
            impedance = own * np.exp(random.uniform(-wrong.contact, wrong.contact, len(own)))
            moved = Layout(centres, layout.diameters, contact_impedance=impedance, outline=layout.known_outline)
            self.skins.append(plain.with_layout(moved))
            later = impedance * np.exp(random.uniform(-wrong.drift, wrong.drift, len(own)))
            after = Layout(centres, layout.diameters, contact_impedance=later, outline=layout.known_outline)
            self.drifts.append(plain.with_layout(after) if wrong.drift else None)

    def changes(self, touches) -> np.ndarray:
        """Relative voltage changes (touches, channels) due to touches, without noise."""
        found = np.zeros((len(touches), self.plain.model.protocol.num_measurements))
        for number, (skin, after) in enumerate(zip(self.skins, self.drifts, strict=True)):
            own = range(number, len(touches), len(self.skins))
            if not len(own):
                continue
            some = [touches[one] for one in own]
            found[list(own)] = relative_changes(skin if after is None else after, some)
            if after is not None:
                rest, later = (np.asarray(one.model.voltages(one.model_conductivity)) for one in (skin, after))
                pressed = later + found[list(own)] * np.maximum(np.abs(later), 1e-3 * np.abs(later).max())
                found[list(own)] = relative_voltage_changes(rest, pressed)
        return found


def grid_touches() -> tuple[list[list[Indent]], np.ndarray]:
    """Touches of a ball of 15 mm diameter, 7.5 mm deep, at 15 × 15 positions, and the positions."""
    places = touches_away_from_the_edge(park_skin().outline, TIP / 2, PLACES, PLACES).places
    return [[Indent(ball_indenter(TIP), TIP_DEPTH, place)] for place in places], places


def tuning_touches(number: int = 60) -> tuple[list[list[Indent]], np.ndarray]:
    """Touches of the ball of `grid_touches` at other positions, by which the hyperparameters of other methods are
    chosen."""
    places = np.random.default_rng(5).uniform(-0.09, 0.09, (number, 2))
    return [[Indent(ball_indenter(TIP), TIP_DEPTH, place)] for place in places], places


def pair_touches(number: int, apart: float = APART, seed: int = 9) -> tuple[list[list[Indent]], np.ndarray]:
    """Touches of two balls at the distance `apart`, at random positions, and the positions (touches, 2, 2) of both
    balls."""
    random, places = np.random.default_rng(seed), []
    while len(places) < number:
        one, angle = random.uniform(-0.085, 0.085, 2), random.uniform(0, 2 * np.pi)
        other = one + apart * np.array([np.cos(angle), np.sin(angle)])
        if np.abs(other).max() < 0.085:
            places.append((one, other))
    touches = [[Indent(ball_indenter(TIP), 6e-3, place) for place in pair] for pair in places]
    return touches, np.array(places)


def unseen_shapes() -> dict[str, object]:
    """Five indenters unlike those in the training data, by name."""
    along = np.linspace(-1, 1, 41)
    x, y = np.meshgrid(along, along)
    triangle = np.where((y > -0.5) & (y < 1 - 1.732 * np.abs(x)), 0.0, np.nan)
    bar = BarIndenter(0.06, 0.012)
    return {
        "ring": RingIndenter(0.060, 0.036),
        "cross": JoinedIndenters(bar, PlacedIndenter(bar, (0.0, 0.0), np.pi / 2)),
        "L": JoinedIndenters(
            PlacedIndenter(BarIndenter(0.06, 0.014), (0.0, -0.023)),
            PlacedIndenter(BarIndenter(0.06, 0.014), (-0.023, 0.0), np.pi / 2),
        ),
        "triangle": DepthMapIndenter(triangle, 0.0018),
        "hand": JoinedIndenters(
            DiscIndenter(0.045),
            *(
                PlacedIndenter(DiscIndenter(0.016), (0.05 * np.cos(a), 0.05 * np.sin(a)))
                for a in (0.2, 0.9, 1.6, 2.3, 3.3)
            ),
        ),
    }


def shape_touches(number: int, seed: int = 13) -> tuple[list[list[Indent]], list[str]]:
    """Touches of the bodies of `unseen_shapes` in turn, rotated and placed at random, 2 to 7 mm deep, and the names of
    the bodies."""
    random, shapes = np.random.default_rng(seed), unseen_shapes()
    names = [list(shapes)[one % len(shapes)] for one in range(number)]
    touches = []
    for name in names:
        place, angle, depth = random.uniform(-0.06, 0.06, 2), random.uniform(-np.pi, np.pi), random.uniform(2e-3, 7e-3)
        touches.append([Indent(shapes[name], depth, place, angle)])  # pyright: ignore[reportArgumentType]
    return touches, names
