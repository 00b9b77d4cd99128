"""Maps of touched skins: jeit beside SciPy and scikit-learn.

Tasks are exact maps of 48 × 48 touches on a sheet and on a layer, compared with one SuperLU factorisation per touch
(measured for a few touches of each map, multiplied by their number); linear maps of many layouts in one batch and one
by one; k-means clustering of the voltage changes of all touches; and exact maps of several meshes, which show how the
time grows with the number of nodes.
"""

from __future__ import annotations

import statistics
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.case import Asked, Case, Headline, Options, Result, Table, judged
from benchmarks.harness.tables import duration, times
from benchmarks.harness.timing import Timed, say, timed
from benchmarks.opponents import scikit_learn
from benchmarks.opponents.scipy_touches import PlainTouches
from benchmarks.problems.skins import SIDE, skin
from jeit.design import Bell, touch_grid
from jeit.design.measurements import nearest_pairs
from jeit.design.skin.touched_cells import touched_cells
from jeit.design.skin.voltage_changes import touch_changes
from jeit.layout import named_layout
from jeit.mesh import Rectangle
from jeit_solvers import kmeans

HEADER = ["task", "nodes", "jeit", "opponent", "times jeit's", "compile", "agreement"]
FASTER, SAME = 30.0, 1e-8
# Cell sizes in metres: first of the map that SciPy computes too, then of maps that show the growth of cost.
CASES = {"sheet": (3.07e-3, 4.3e-3, 6.3e-3), "layer": (4.34e-3, 6e-3, 8e-3)}


class ExactMap(NamedTuple):
    """Numbers of nodes and touches of an exact map, jeit's time, SciPy's seconds, and the largest relative difference
    between both maps (the last two may be None)."""

    nodes: int
    touches: int
    spent: Timed
    theirs: float | None
    worst: float | None

    def row(self, kind: str) -> list[str]:
        """The row of the table for this map."""
        row = [f"exact map, {kind}, {self.touches} touches", str(self.nodes), duration(self.spent.median)]
        if self.theirs is None:
            return [*row, "", "", duration(self.spent.compile), ""]
        ratio = times(self.theirs / self.spent.median)
        return [*row, f"SciPy: {duration(self.theirs)}", ratio, duration(self.spent.compile), f"{self.worst:.0e}"]


def run(options: Options) -> Result:
    """Measure exact maps, clusters and batches of layouts."""
    quick, rounds = options.quick, options.rounds or (1 if options.quick else 3)
    cases = {"sheet": (7e-3,)} if quick else CASES
    places, sample = (12, 3) if quick else (48, 12)
    rows, asked, wrong, headline = [], [], [], None
    for kind, sizes in cases.items():
        found = [exact_map(kind, sizes[0], places, sample, 3 * rounds)]
        found += [exact_map(kind, size, places, 0, 1) for size in sizes[1:]]
        rows += [one.row(kind) for one in found]
        for row in rows[-len(found) :]:
            say(" | ".join(row))
        asked += _asked_of_maps(kind, found)
        if found[0].worst is None or not found[0].worst < SAME:
            wrong.append(f"exact map, {kind}: jeit and SciPy differ by {found[0].worst:.0e}")
        headline = _headline(kind, found[0])
    rows.append(clusters(rounds, quick))
    say(" | ".join(rows[-1]))
    batches, cost = many_layouts((2, 4) if quick else (16, 64, 256), rounds)
    rows += batches
    asked.append(_growth("linear maps: cost grows as layouts to the power", cost))
    return Result([Table(HEADER, rows)], asked, headline=headline, wrong=wrong)


def exact_map(kind: str, cell_size: float, places: int, sample: int, rounds: int) -> ExactMap:
    """Measure the exact map of touches all over one skin. SciPy's time is extrapolated from `sample` touches; SciPy is
    left out if `sample` is 0."""
    model, conductivity, options = skin(kind, cell_size)
    grid = touch_grid(Rectangle(SIDE, SIDE), places, places)
    touched = touched_cells(model.mesh, Bell(), grid.places, **options)
    spent = timed(lambda: touch_changes(model, conductivity, touched), rounds)
    nodes, number = model.mesh.num_points, len(grid.places)
    if not sample:
        return ExactMap(nodes, number, spent, None, None)
    found, plain = np.asarray(spent.answer), PlainTouches(model, conductivity)
    each, worst = [], 0.0
    for k in np.linspace(0, number - 1, sample).astype(int):
        start = time.perf_counter()
        expected = plain.change(np.asarray(touched.cells[k]), np.asarray(touched.change[k]))
        each.append(time.perf_counter() - start)
        worst = max(worst, float(np.abs(found[k] - expected).max() / np.abs(expected).max()))
    return ExactMap(nodes, number, spent, statistics.median(each) * number, worst)


def many_layouts(numbers: tuple[int, ...], rounds: int) -> tuple[list[list[str]], list[tuple[int, float]]]:
    """Table rows for linear maps of several numbers of layouts, computed in one batch and one after the other, and the
    seconds of each batch.
    """
    model, conductivity, options = skin("sheet", 6.3e-3)
    touched = touched_cells(model.mesh, Bell(), touch_grid(Rectangle(SIDE, SIDE), 24, 24).places, **options)
    sigma = jnp.asarray(conductivity)

    def theta(move):
        electrodes = eqx.tree_at(lambda e: e.position, model.electrodes, model.electrodes.position + move)
        changes = touch_changes(eqx.tree_at(lambda m: m.electrodes, model, electrodes), sigma, touched, linear=True)
        return jnp.linalg.norm(changes, axis=1)

    batch, one = jax.jit(lambda moves: jax.lax.map(theta, moves)), jax.jit(theta)
    rows, cost = [], []
    for number in numbers:
        moves = 1e-3 * jax.random.normal(jax.random.key(0), (number, 32, 2))
        together = timed(lambda moves=moves: batch(moves), rounds)
        # One after the other, every layout takes the same time, so only a few layouts are timed.
        few = moves[:16]
        alone = timed(lambda few=few: [jax.block_until_ready(one(move)) for move in few], rounds).median / len(few)
        same = float(jnp.max(jnp.abs(together.answer[-1] / one(moves[-1]) - 1)))
        needed = batch.lower(moves).compile().memory_analysis()
        memory = (needed.temp_size_in_bytes + needed.output_size_in_bytes) / 2**20
        each = together.median / number
        name = f"linear maps of {number} layouts, 576 touches, each; {memory:.0f} MB for all"
        row = [name, str(model.mesh.num_points), duration(each), f"a loop: {duration(alone)}", times(alone / each)]
        rows.append([*row, duration(together.compile), f"{same:.0e}"])
        say(" | ".join(rows[-1]))
        cost.append((number, together.median))
    return rows, cost


def clusters(rounds: int, quick: bool) -> list[str]:
    """A table row for k-means with 90 clusters of 2,304 vectors (touches) of 94 voltage changes, compared with
    scikit-learn on one thread."""
    model, conductivity, options = skin("sheet", 7e-3 if quick else 5e-3)
    grid, number = touch_grid(Rectangle(SIDE, SIDE), *((12, 12) if quick else (48, 48))), 10 if quick else 90
    touched = touched_cells(model.mesh, Bell(), grid.places, **options)
    chosen = np.sort(nearest_pairs(named_layout("park-inner").centres, 94))
    vectors = np.asarray(touch_changes(model, conductivity, touched, linear=True))[:, chosen]
    spent = timed(lambda: kmeans(vectors, number, jax.random.key(0)), rounds)
    draws = 1 if quick else 3
    theirs, inertia = scikit_learn.kmeans(vectors, number, rounds, draws)
    mine = statistics.median(float(kmeans(vectors, number, jax.random.key(k)).inertia) for k in range(draws))
    row = [f"k-means, {number} clusters of {len(vectors)} × 94, 10 restarts", "", duration(spent.median)]
    row += [f"scikit-learn: {duration(theirs.median)}", times(theirs.median / spent.median), duration(spent.compile)]
    return [*row, f"inertia {100 * (mine / inertia - 1):+.1f} %"]


def _asked_of_maps(kind: str, found: list[ExactMap]) -> list[Asked]:
    faster = (found[0].theirs or 0.0) / found[0].spent.median
    asked = [judged(f"exact map, {kind}: ≥ 30× one factorisation per touch", f"{faster:.0f}×", faster >= FASTER)]
    if len(found) > 1:
        cost = [(one.nodes, one.spent.median) for one in found]
        asked.append(_growth(f"exact map, {kind}: cost grows as nodes to the power", cost))
    return asked


def _growth(asked: str, cost: list[tuple[int, float]]) -> Asked:
    """The exponent with which seconds grow with the number of nodes or layouts; it is reported but not judged. `cost`
    has pairs of number and seconds."""
    return Asked(asked, f"{np.polyfit(*np.log(np.array(cost)).T, 1)[0]:.2f}")


def _headline(kind: str, found: ExactMap) -> Headline:
    job = f"exact voltages of {found.touches:,} touches of a {kind}, {found.nodes:,} nodes"
    ratio = times((found.theirs or 0.0) / found.spent.median)
    other = f"SciPy: {duration(found.theirs or float('nan'))}"
    return Headline(job, duration(found.spent.median), other, ratio, f"same to {found.worst:.0e}")


CASE = Case("design", "maps of touched skins and clusters of touches: jeit beside SciPy and scikit-learn", run, 4)
