"""Speed of self-organising maps in training and evaluation, beside MiniSom and one-step images.

A map of 32 by 32 neurons is trained on 10,000 frames of 208 voltages of a simulated skin, each presented once, in an
ordering and a tuning phase. MiniSom is trained on the same frames in the same order, and ends with the same weights.
"""

from __future__ import annotations

import time

import jax.numpy as jnp
import numpy as np
from minisom import MiniSom

from benchmarks.harness.case import Case, Headline, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say, timed
from benchmarks.problems.weighed_skins import WeighedSkin
from jeit.inverse import one_step
from jeit.touch import PlacedMap, SelfOrganisingMap
from jeit.touch.kohonen import MapSchedule
from jeit.touch.kohonen.training import train

FRAMES, SHAPE, ASKED_S, TIMES, FRAME_S = 10_000, (32, 32), 5.0, 20.0, 0.2e-3


def run(options: Options) -> Result:
    """Time the training by jeit and MiniSom, then the evaluation of one frame."""
    number, nodes, turns = (300, 800, 2) if options.quick else (FRAMES, 4000, 5)
    skin = WeighedSkin("disk", nodes)
    frames, places = skin.presses(10, number)
    random = np.random.default_rng(0)
    schedule = MapSchedule(number // 5, number - number // 5, (0.3, 0.02))
    order, start = random.permutation(number), 1e-3 * random.normal(size=(*SHAPE, frames.shape[1]))
    rates, radii = schedule.rates(), schedule.radii(SHAPE)
    given = jnp.asarray(start), jnp.asarray(frames), order, rates, radii
    begun = time.perf_counter()
    learnt = np.asarray(train(*given)[0])
    first = time.perf_counter() - begun
    ours = timed(lambda: np.asarray(train(*given)[0]), turns)
    say(f"ours {duration(ours.median)}")
    begun = time.perf_counter()
    theirs = _minisom(start, frames, order, rates, radii)
    seconds = time.perf_counter() - begun
    apart = float(np.abs(learnt - theirs).max() / np.abs(theirs).max())
    ratio = seconds / ours.median
    rows = [
        ["jeit", duration(first - ours.median), duration(ours.median), f"{1e6 * ours.median / number:.0f} µs", ""],
        ["MiniSom", "", duration(seconds), f"{1e6 * seconds / number:.0f} µs", f"{apart:.1e}"],
    ]
    header = ["by", "compilation", f"{number:,} frames", "each", "difference of weights, relative"]
    tables = [Table(header, rows, "A map of 32 × 32 neurons, 208 voltages")]
    placed = PlacedMap.learn(SelfOrganisingMap(learnt, 1.0), frames, places)
    model = skin.model(560)
    image = one_step(model, float(skin.skin.conductivity[0]))
    rest = skin.skin.rest()
    one = frames[:1]
    asked_of = {
        "map: activity of all neurons": lambda: placed.learnt.activity(one),
        "map: place and deviation": lambda: placed.locate(one),
        "one-step image of 1,024 cells": lambda: image.image(one[0] - rest),
    }
    times = {name: timed(ask, 20 if options.quick else 300).median for name, ask in asked_of.items()}
    theirs_ms = {"map: activity of all neurons": "20 ms", "one-step image of 1,024 cells": "260 ms"}
    rows = [[name, duration(taken), theirs_ms.get(name, "")] for name, taken in times.items()]
    tables.append(Table(["one frame", "time", "the paper, MATLAB"], rows, "One frame"))
    if options.quick:
        return Result(tables)
    worst = max(times["map: activity of all neurons"], times["map: place and deviation"])
    asked = [
        judged("10,000 frames learnt in 5 s", duration(ours.median), ours.median <= ASKED_S),
        judged("20 times as quick as MiniSom", f"{ratio:.0f} times", ratio >= TIMES),
        judged("a frame in 0.2 ms", duration(worst), worst <= FRAME_S),
        judged("MiniSom's weights to 1e-6", f"{apart:.1e}", apart <= 1e-6),
    ]
    headline = Headline(
        "a self-organising map of 10,000 frames",
        duration(ours.median),
        f"MiniSom {duration(seconds)}",
        f"{ratio:.0f} ×",
        f"same weights to {apart:.0e}",
    )
    return Result(tables, asked, headline=headline)


def _minisom(start, frames, order, rates, radii) -> np.ndarray:
    """MiniSom's final weights. In the tuning phase, the radius is so small that only the winning neuron learns."""
    theirs = MiniSom(*start.shape)
    radii = np.append(radii, np.full(len(order) - len(radii), 0.01))
    theirs._weights = start.copy()
    theirs._learning_rate_decay_function = lambda rate, step, steps: rates[step]
    theirs._sigma_decay_function = lambda radius, step, steps: radii[step]
    for step, number in enumerate(order):
        theirs.update(frames[number], theirs.winner(frames[number]), step, len(order))
    return theirs._weights


CASE = Case("kohonen_speed", "self-organising maps: learning and one frame, beside MiniSom", run, 2)
