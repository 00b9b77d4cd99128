"""Voltages, Jacobians, linear images, and batches of these: jeit compared with SciPy and pyEIT on the same disks.

Meshes, protocols and conductivities are the same for all contestants. Every contestant runs in its own process, and
their turns are interleaved. The complete electrode model is compared with SciPy, the point electrode model with pyEIT,
which has no other.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.cases.forward.checks import JACOBIAN, checks
from benchmarks.cases.forward.match import TASKS, Match, Settings, play
from benchmarks.cases.forward.table import table
from benchmarks.harness import environment
from benchmarks.harness.case import Case, Headline, Options, Result
from benchmarks.harness.tables import cell, markdown, ratio
from benchmarks.harness.timing import say

# Numbers of nodes of the meshes for each number of electrodes. Figures are judged for 16 electrodes only. With 32
# electrodes, voltages and Jacobian show the growth of cost.
NODES = {16: (1150, 5000, 20_000), 32: (5000,)}


def run(options: Options) -> Result:
    """Run all matches, one after the other."""
    python = None if options.without_pyeit else environment.python("pyeit", create=not options.quick)
    matches: list[Match] = []
    with tempfile.TemporaryDirectory() as folder:
        for num_electrodes, num_points, settings in _plan(options, python):
            for model in ("complete", "point"):
                say(f"{num_points} nodes, {num_electrodes} electrodes, {model} electrode model …")
                matches.append(play(num_points, num_electrodes, model, settings, matches, Path(folder)))
                # A run that is stopped has reported its previous results.
                shown = table(matches[-1:])
                say(markdown(shown.header, shown.rows))
    wrong = [
        f"{match.num_points} nodes, {match.num_electrodes} electrodes: {match.accuracy}"
        for match in matches
        if not match.agreed
    ]
    notes = sorted({line for match in matches for line in match.descriptions})
    return Result([table(matches)], checks(matches), notes, _headline(matches), wrong)


def _plan(options: Options, python: str | None):
    """Yield the number of electrodes, the number of nodes and the settings of each pair of matches."""
    rounds, budget, limit = options.rounds or 15, 2.0, options.time_limit or 120.0
    if options.quick:
        yield 16, 200, Settings(options.rounds or 2, 0.5, limit, python, TASKS[:-1])
        return
    for num_electrodes in options.electrodes or tuple(NODES):
        tasks = TASKS if num_electrodes == 16 or options.electrodes else TASKS[:2]
        for num_points in options.nodes or NODES.get(num_electrodes, NODES[16]):
            yield num_electrodes, num_points, Settings(rounds, budget, limit, python, tasks)


def _headline(matches: list[Match]) -> Headline | None:
    """The headline: the Jacobian at about 5,000 nodes with 16 electrodes, compared with the fastest opponent."""
    fitting = [one for one in matches if one.model == "complete" and one.num_electrodes == 16]
    if not fitting:
        return None
    match = min(fitting, key=lambda one: abs(one.num_points - 5000))
    figures = match.figures[JACOBIAN]
    mine = figures["jeit"]
    others = {name: one for name, one in figures.items() if name != "jeit" and one.seconds and not one.remark}
    if not others:
        return None
    name, best = min(others.items(), key=lambda pair: pair[1].median)
    label = {"scipy plain": "SciPy", "scipy tuned": "SciPy, tuned"}.get(name, name)
    accuracy = f"same to {match.accuracy.get(f'{JACOBIAN} J', float('nan')):.0e}"
    job = f"voltages and Jacobian, {match.num_points:,} nodes, 16 electrodes"
    return Headline(job, cell(mine), f"{label}: {cell(best)}", ratio(best, mine), accuracy)


CASE = Case("forward", "voltages, Jacobians, linear images, batches: jeit beside SciPy and pyEIT", run, minutes=7)
