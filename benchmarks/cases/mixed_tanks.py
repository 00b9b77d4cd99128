"""One to three strong bodies in a tank, metal, plastic or both: the default image compared with one-step images.

The simulated tanks are those of `problems/mixed_tanks.py`, solved without jeit, with 1 % noise on every voltage. None
of these tanks was used to set the defaults.
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems.mixed_tanks import draw, matched
from jeit import image_difference
from jeit.imaging import ImagingSettings

TANKS, FIRST = 200, 500_000
FAR, MEDIAN = 0.12, 0.045
METHODS = ("auto", "one-step")
HEADER = ["channels", "image", "tanks", "bodies", "median / R", "beyond 0.12 R", "missed", "spurious"]


def run(options: Options) -> Result:
    """Image all tanks; the table has a row for each kind of channels, and a row for all tanks."""
    seeds = range(FIRST, FIRST + (1 if options.quick else TANKS))
    rows: dict[tuple[str, str], list[tuple[np.ndarray, int]]] = {}
    refused = []
    for seed in seeds:
        tank = draw(seed)
        channels = tank.frame.protocol.name.split(",")[0].split(" electrode")[0]
        for method in METHODS:
            try:
                found = image_difference(
                    tank.frame,
                    tank.reference,
                    ImagingSettings(method=method, num_points=800 if options.quick else 2000),
                )
            except ValueError as error:
                refused.append(f"tank {seed}, {channels}: {error}")
                break
            distances, spurious = matched(tank, found.inclusions)
            outcome = distances, spurious
            for name in (channels, "all"):
                rows.setdefault((name, method), []).append(outcome)
            say(f"{seed} {channels} {method} {found.settings.method} {np.round(distances, 3)} {spurious} spurious")
    names = sorted({name for name, _ in rows}, key=lambda name: (name == "all", name))
    table = [_row(name, method, rows[name, method]) for name in names for method in METHODS]
    distances, spurious = _together(rows["all", "auto"])
    asked = [
        judged(f"median ≤ {MEDIAN} R", f"{np.median(distances):.3f} R", bool(np.median(distances) <= MEDIAN)),
        judged(f"all ≤ {FAR} R", f"{np.mean(distances <= FAR):.1%}", bool((distances <= FAR).all())),
        judged("none missed", f"{np.isinf(distances).sum()}", bool(np.isfinite(distances).all())),
        judged("none spurious", f"{spurious}", spurious == 0),
    ]
    notes = [f"{len(refused)} of {len(seeds)} tanks refused as too noisy", *(one[:160] for one in refused)]
    return Result([Table(HEADER, table)], asked, notes)


def _together(outcomes) -> tuple[np.ndarray, int]:
    distances, spurious = zip(*outcomes, strict=True)
    return np.concatenate(distances), sum(spurious)


def _row(name: str, method: str, outcomes) -> list[str]:
    distances, spurious = _together(outcomes)
    missed = np.isinf(distances)
    figures = [f"{np.median(distances):.3f}", str((distances[~missed] > FAR).sum()), str(missed.sum()), str(spurious)]
    return [name, method, str(len(outcomes)), str(len(distances)), *figures]


CASE = Case("mixed_tanks", "strong bodies in simulated tanks that were not used to set defaults", run, 5, timed=False)
