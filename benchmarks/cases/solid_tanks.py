"""One or two balls or columns in boxes and cylinders, imaged with the defaults. The simulated tanks are those of
`problems/solid_tanks.py`.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems.solid_tanks import draw, matched
from jeit import image_difference
from jeit.imaging import ImagingSettings

TANKS, FIRST = 20, 700_000
COLUMNS, FIRST_COLUMNS = 6, 720_000
_CONTRAST = 0.15
HEADER = ["tank", "electrodes", "channels", "method", "bodies"]
HEADER += ["off / r", "volume", "contrast", "± 1 σ", "reported as", "others", "seconds"]


def run(options: Options) -> Result:
    """Image all tanks; the table has one row for each tank."""
    rows, off, contrasts, spurious, missed, held, refused = [], [], [], 0, 0, 0, []
    tanks = [(seed, False) for seed in range(FIRST, FIRST + TANKS)]
    tanks += [(seed, True) for seed in range(FIRST_COLUMNS, FIRST_COLUMNS + COLUMNS)]
    for seed, columns in tanks[:1] if options.quick else tanks:
        tank, start = draw(seed, columns=columns), time.perf_counter()
        try:
            found = image_difference(
                tank.frame, tank.reference, ImagingSettings(num_points=2000 if options.quick else None)
            )
        except ValueError as error:
            refused.append(f"tank {seed}: {error}"[:160])
            continue
        seconds = time.perf_counter() - start
        bodies = () if found.shapes is None else found.shapes.bodies
        which, more = matched(tank, [body.centroid for body in bodies], [body.sign for body in bodies])
        matches = [(ball, bodies[one]) for ball, one in zip(tank.balls, which, strict=True) if one >= 0]
        background = float(found.calibration.conductivity)
        ends = [1 + np.array(found.peak_ranges[one]) / background for one in which if one >= 0]
        distance = [float(np.linalg.norm(body.centroid - ball.centre)) / ball.radius for ball, body in matches]
        volume = [body.volume / ball.volume for ball, body in matches]
        contrast = [float(np.exp(body.sign * body.contrast)) / ball.factor for ball, body in matches]
        off, contrasts, spurious = off + distance, contrasts + contrast, spurious + more
        held += sum(low <= ball.factor <= high for (ball, _), (low, high) in zip(matches, ends, strict=True))
        missed += len(tank.balls) - len(matches)
        factors = ", ".join(f"{ball.factor:g}" for ball in tank.balls)
        figures = [" ".join(f"{one:.2f}" for one in many) for many in (distance, volume, contrast)]
        forms = ["column" if found.inclusions[one].is_column else "ellipsoid" for one in which if one >= 0]
        figures += [", ".join(f"{low:.2g} to {high:.2g}" for low, high in ends), ", ".join(forms)]
        kind = tank.frame.protocol.name.split(",")[0]
        electrodes = f"{tank.kind}, columns" if columns else tank.kind
        rows.append(
            [str(seed), electrodes, kind, found.settings.method, factors, *figures, str(more), f"{seconds:.0f}"]
        )
        say(" | ".join(rows[-1]))
    close = sum(abs(one - 1) <= _CONTRAST for one in contrasts)
    total = len(off) + missed
    checks = [
        judged("contrasts ≤ 15 % off", f"{close} of {total}", close == total),
        judged("ranges that hold the truth ≥ 68 %", f"{held} of {len(off)}", held >= 0.68 * len(off)),
        judged("none missed", str(missed), missed == 0),
        judged("nothing else reported", str(spurious), spurious == 0),
    ]
    return Result([Table(HEADER, rows)], checks, [f"{len(refused)} tanks refused", *refused])


CASE = Case("solid_tanks", "balls and columns in simulated tanks: places, volumes, contrasts", run, 40, timed=False)
