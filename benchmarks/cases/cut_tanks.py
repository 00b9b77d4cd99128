"""Tanks like the Kuopio challenge's with 0 to 12 missing electrodes: the score of the default segmentation.

The simulated tanks are those of `problems/cut_tanks.py`, solved without jeit. None of these tanks was used to set the
defaults.
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table
from benchmarks.harness.timing import say
from benchmarks.problems.cut_tanks import draw
from jeit import image_difference
from jeit.image.rasters import challenge_score
from jeit.imaging import ImagingSettings

TANKS, FIRST = 70, 200_000
METHODS = ("auto", "total-variation")


def run(options: Options) -> Result:
    """Segment the tanks, each at one level in turn; the table states the mean score of the challenge for each level."""
    seeds = range(FIRST, FIRST + (1 if options.quick else TANKS))
    scores: dict[tuple[str, int], list[float]] = {}
    for seed in seeds:
        level = 1 + seed % 7
        tank = draw(seed).without(2 * (level - 1))
        for method in METHODS:
            settings = ImagingSettings(method=method, segment=True, num_points=800 if options.quick else 2000)
            found = image_difference(tank.frame, tank.reference, settings)
            assert found.labels is not None
            score = challenge_score(found.labels, tank.truth)
            for name in (level, 0):
                scores.setdefault((method, name), []).append(score)
            say(f"tank {seed}, level {level}, {method}: {score:.3f}")
    levels = sorted({level for _, level in scores}, key=lambda level: (level == 0, level))
    rows = [
        [
            str(level or "all"),
            str(len(scores[METHODS[0], level])),
            *(f"{np.mean(scores[method, level]):.3f}" for method in METHODS),
        ]
        for level in levels
    ]
    return Result([Table(["level", "tanks", *METHODS], rows)], [])


CASE = Case("cut_tanks", "segmentations of simulated tanks with missing electrodes", run, 5, timed=False)
