"""The speed benchmark, in one command: `python -m benchmarks` from the root of the repository.

jeit beside pyEIT and SciPy on the same meshes, protocols and conductivities, in one run, turns interleaved.
See `README.md` in this folder for what is measured and how.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.cases import startup
from benchmarks.cases.forward.checks import checks
from benchmarks.cases.forward.match import TASKS, Match, Settings, play
from benchmarks.harness import environment as pyeit_environment
from benchmarks.harness import machine
from benchmarks.harness.contest import CORES, ROOT
from benchmarks.harness.report import markdown, table, write_between_markers


def parse() -> argparse.Namespace:
    """Options of the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="See benchmarks/README.md.")
    parser.add_argument("--nodes", type=int, nargs="+", default=[1150, 5000, 20000], help="sizes of the meshes")
    parser.add_argument("--electrodes", type=int, nargs="+", default=[16, 32])
    parser.add_argument("--rounds", type=int, default=15, help="turns each contestant has at each task")
    parser.add_argument("--budget", type=float, default=20.0, help="seconds a contestant may use for a task")
    parser.add_argument("--time-limit", type=float, default=120.0, help="seconds for one call, then it has given up")
    parser.add_argument("--without-pyeit", action="store_true")
    parser.add_argument("--quick", action="store_true", help="a smoke run in less than a minute: one small mesh")
    parser.add_argument("--json", type=Path, help="also write every figure to this file")
    parser.add_argument("--write-readme", action="store_true", help="put the table between the README's markers")
    return parser.parse_args()


def main() -> int:
    """Run, print the report, and return 1 if contestants disagree or, in a full run, a figure is missed."""
    options = parse()
    machine.use_cores(CORES)
    heading = machine.heading()
    if options.quick:
        options.nodes, options.electrodes, options.rounds, options.budget = [200], [16], 2, 2.0
    python = None if options.without_pyeit else pyeit_environment.python(create=not options.quick)
    settings = Settings(
        rounds=options.rounds,
        budget=options.budget,
        limit=options.time_limit,
        pyeit_python=None if python is None else str(python),
        tasks=TASKS[:-1] if options.quick else TASKS,
    )
    start = time.perf_counter()
    matches: list[Match] = []
    with tempfile.TemporaryDirectory() as folder:
        for num_electrodes in options.electrodes:
            for num_points in options.nodes:
                for model in ("complete", "point"):
                    say(f"{num_points} nodes, {num_electrodes} electrodes, {model} electrode model …")
                    matches.append(play(num_points, num_electrodes, model, settings, matches, Path(folder)))
                    # A run that is stopped has said what it knew.
                    say(table(matches[-1:]))
    say("cold starts …")
    import_seconds = startup.import_seconds(2 if options.quick else 5)
    demo_seconds = None if options.quick else startup.demo_seconds()
    outcome = checks(matches, import_seconds, demo_seconds)
    text = "\n\n".join(
        [
            "\n".join(f"- {line}" for line in [*heading, *sorted({line for m in matches for line in m.descriptions})]),
            table(matches),
            markdown(["asked", "measured", ""], [[c.asked, c.measured, c.verdict] for c in outcome]),
        ]
    )
    print(text)
    say(f"{time.perf_counter() - start:.0f} s in all")
    if options.json:
        options.json.write_text(json.dumps({"heading": heading, "matches": [m.as_dict() for m in matches]}, indent=1))
    if options.write_readme:
        write_between_markers(ROOT / "README.md", text)
    wrong = [m for m in matches if not m.agreed]
    for match in wrong:
        say(f"DISAGREEMENT: {match.num_points} nodes, {match.num_electrodes} electrodes: {match.accuracy}")
    missed = [check for check in outcome if check.verdict == "missed"]
    return 1 if wrong or (missed and not options.quick) else 0


def say(text: str) -> None:
    """Progress, apart from the report."""
    print(text, file=sys.stderr, flush=True)
