"""Frames of pressed skins, from loads to voltages: jeit beside one SciPy factorisation per touch.

A round skin of 5,000 nodes is pressed by balls only, and by balls, discs and prisms, alone and in pairs. jeit computes
the pressure in equilibrium with the load, the change of conductivity by the material's law, and the exact changes of
voltages. SciPy receives the changed conductivities; its time is measured for a few touches and extrapolated to their
number. Two further tasks are a stroke in time, and a contact on an elastic half-space.
"""

from __future__ import annotations

import statistics
import time

import jax
import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration, times
from benchmarks.harness.timing import say, timed
from benchmarks.opponents.scipy_touches import PlainTouches
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch.simulate import (
    DiscIndenter,
    HalfSpace,
    MovingPress,
    PressDraws,
    PressedSkin,
    PrismIndenter,
    ball_indenter,
    material,
)

HEADER = ["task", "nodes", "jeit", "touches a second", "SciPy", "times jeit's", "compile", "agreement"]
KEY = jax.random.key(0)
RADIUS, LOADS = 0.05, (0.3, 10.0)
FAST, FASTER, SAME = 500.0, 50.0, 1e-8
BALLS, MIXED, PAIRS = "balls of 15 mm", "balls, discs and prisms", "the same, one or two at once"


def run(options: Options) -> Result:
    """Measure sets of touches, a stroke, and a contact."""
    nodes, number = (options.nodes or (600 if options.quick else 5000,))[0], 32 if options.quick else 1024
    rounds, sample = options.rounds or (1 if options.quick else 5), 2 if options.quick else 12
    mesh = Disk(RADIUS).mesh(num_points=nodes)
    model = ForwardModel(mesh, BoundaryElectrodes(ring(RADIUS, 16), 0.008, 300.0), adjacent(16))
    skin = PressedSkin(KEY, model, material("velostat"))
    shapes = [ball_indenter(0.015), DiscIndenter(0.01), PrismIndenter(0.02, 0.01, 0.005)]
    sets = {
        BALLS: PressDraws(shapes[:1], Disk(RADIUS), LOADS, margin=0.008),
        MIXED: PressDraws(shapes, Disk(RADIUS), LOADS, margin=0.01),
        PAIRS: PressDraws(shapes, Disk(RADIUS), LOADS, margin=0.01, at_once=2),
    }
    rows, asked, wrong = [], [], []
    for name, draws in sets.items():
        touches = draws.draw(KEY, number)
        spent = timed(lambda touches=touches: skin.frames(KEY, touches), rounds)
        theirs, worst = _plainly(skin, touches, sample)
        ratio, rate = number * theirs / spent.median, number / spent.median
        row = [f"{number} touches: {name}", str(mesh.num_points), duration(spent.median), f"{rate:,.0f}"]
        rows.append([*row, duration(number * theirs), times(ratio), duration(spent.compile), f"{worst:.0e}"])
        say(" | ".join(rows[-1]))
        if name != PAIRS:
            asked.append(judged(f"{name}: ≥ 500 touches a second", f"{rate:,.0f} /s", rate >= FAST))
        if name == BALLS:
            asked.append(judged(f"{name}: ≥ 50× one factorisation a touch", f"{ratio:.0f}×", ratio >= FASTER))
        if not worst < SAME:
            wrong.append(f"{name}: jeit and SciPy differ by {worst:.0e}")
    rows += [_stroke(skin, 16 if options.quick else 500, rounds), _half_space(rounds)]
    return Result([Table(HEADER, rows)], asked, wrong=wrong)


def _plainly(skin: PressedSkin, touches: list, sample: int) -> tuple[float, float]:
    """SciPy's seconds per touch with one factorisation per touch, and the largest difference between SciPy's and jeit's
    changes of voltages, relative to the largest change.
    """
    plain = PlainTouches(skin.model, np.asarray(skin.conductivity))
    chosen = [touches[k] for k in np.linspace(0, len(touches) - 1, sample).astype(int)]
    touched = skin.touched(chosen)
    found = skin.voltages_under(touched) - np.asarray(skin.model.voltages(skin.conductivity))
    each, wrong, largest = [], 0.0, 0.0
    for k in range(sample):
        start = time.perf_counter()
        expected = plain.change(np.asarray(touched.cells[k]), np.asarray(touched.change[k]))
        each.append(time.perf_counter() - start)
        wrong, largest = max(wrong, np.abs(found[k] - expected).max()), max(largest, np.abs(expected).max())
    return statistics.median(each), float(wrong / largest)


def _stroke(skin: PressedSkin, number: int, rounds: int) -> list[str]:
    """A table row for a disc that moves over the skin at 60 Hz, with creep and hysteresis everywhere on its path."""
    along = np.linspace(-0.03, 0.03, number)
    stroke = MovingPress(DiscIndenter(0.01), np.full(number, 3.0), np.stack([along, 0 * along], axis=-1))
    seconds = np.arange(number) / 60
    spent = timed(lambda: skin.record(KEY, stroke, seconds), rounds)
    row = [f"a stroke of {number} frames", str(skin.model.mesh.num_points), duration(spent.median)]
    return [*row, f"{number / spent.median:,.0f}", "", "", duration(spent.compile), ""]


def _half_space(rounds: int) -> list[str]:
    """A table row for one contact on an elastic half-space, whose maximum pressure is compared with Hertz's formula."""
    support, indenter, load = HalfSpace(1e6, 0.5, 128), ball_indenter(0.02), 0.05
    spent = timed(lambda: support.pressure(indenter, load).values.max(), rounds)
    radius = (3 * load * 0.01 / (4 * support.plane_modulus)) ** (1 / 3)
    error = float(spent.answer) / (3 * load / (2 * np.pi * radius**2)) - 1
    row = ["a ball on a half-space, 128 × 128 pixels", "", duration(spent.median), f"{1 / spent.median:,.0f}"]
    return [*row, "", "", "", f"Hertz: {100 * error:+.2f} %"]


CASE = Case("contact", "frames of pressed skins, from loads to voltages, beside one factorisation a touch", run, 1.0)
