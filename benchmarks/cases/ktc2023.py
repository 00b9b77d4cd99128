"""The Kuopio Tomography Challenge 2023 on its four training targets.

Difficulty level l leaves out electrodes 1 to 2(l - 1), for current injection and for measurement. The seven levels are
produced from the complete data by masking frame and reference. `jeit reconstruct --segment` with its defaults, which
were set on simulated tanks (`problems/cut_tanks.py`), is compared with total variation.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import scipy.io

from benchmarks.harness.case import NOT_MEASURED, Asked, Case, Headline, Options, Result, Table, judged
from benchmarks.harness.machine import ROOT
from benchmarks.harness.timing import say
from benchmarks.problems.cut_tanks import without
from jeit.data import read
from jeit.image.rasters import challenge_score
from jeit.imaging import ImagedDifference, ImagingSettings, image_difference

LEVELS, TARGETS = range(1, 8), range(1, 5)
METHOD, OTHER = "auto", "total-variation"
# Required mean scores over all levels, and over the levels from the fourth on.
ALL, HARD = 0.8, 0.7


def run(options: Options) -> Result:
    """Segment all levels of all targets, or one level of one target in a quick run; nothing without the challenge's
    data."""
    asked = f"mean score of all levels ≥ {ALL}", f"mean score of levels 4 to 7 ≥ {HARD}"
    folder = _folder(options.data)
    if folder is None:
        note = "the challenge's training data (ref.mat, data1.mat … true4.mat) are not there: give --data FOLDER"
        return Result([Table(["level", "mean"], [])], [Asked(one, "–", NOT_MEASURED) for one in asked], [note])
    levels, targets, nodes = (LEVELS[:1], TARGETS[:1], 400) if options.quick else (LEVELS, TARGETS, 2000)
    table, other = (scores(folder, method, nodes, levels, targets, say) for method in (METHOD, OTHER))
    rows = [
        [str(level), *(f"{value:.3f}" for value in row), f"**{row.mean():.3f}**", f"{beside.mean():.3f}"]
        for level, row, beside in zip(levels, table, other, strict=True)
    ]
    rows.append(["all", *len(targets) * [""], f"**{table.mean():.3f}**", f"{other.mean():.3f}"])
    header = ["level", *(f"target {target}" for target in targets), "mean", OTHER.replace("-", " ")]
    every, hard = float(table.mean()), float(table[3:].mean()) if len(levels) > 3 else float("nan")
    job = f"Kuopio Tomography Challenge 2023, {len(targets)} targets, score of all {len(levels)} levels"
    headline = Headline(job, f"{every:.3f}", accuracy=f"{hard:.3f} over levels 4 to 7")
    verdicts = [judged(asked[0], f"{every:.3f}", every >= ALL), judged(asked[1], f"{hard:.3f}", hard >= HARD)]
    return Result([Table(header, rows)], verdicts, headline=headline)


def _folder(data: Path | None) -> Path | None:
    """The folder of the challenge's data: the given one, or `ktc2023` in it, in JEIT_DATA or in ../shared/data."""
    named = data or Path(os.environ.get("JEIT_DATA", ROOT.parent / "shared" / "data"))
    return next((path for path in (named, named / "ktc2023") if (path / "ref.mat").is_file()), None)


def scores(
    folder: Path, method: str, num_points: int = 2000, levels=LEVELS, targets=TARGETS, report=print
) -> np.ndarray:
    """The challenge's scores (levels, targets) of the segmentations by `method`."""
    table = np.zeros((len(levels), len(targets)))
    settings = ImagingSettings(method=method, segment=True, num_points=num_points)
    for row, level in enumerate(levels):
        for column, target in enumerate(targets):
            start = time.perf_counter()
            found = imaged(folder, target, level, settings)
            seconds = time.perf_counter() - start
            table[row, column] = score(found, folder, target)
            report(f"{method}, level {level}, target {target}: {table[row, column]:.3f}  ({seconds:.1f} s)")
    return table


def imaged(folder: Path, target: int, level: int, settings: ImagingSettings) -> ImagedDifference:
    """The image of a target at a level."""
    gone = list(range(2 * (level - 1)))
    frame, reference = (without(read(folder / name), gone) for name in (f"data{target}.mat", "ref.mat"))
    return image_difference(frame, reference, settings)


def score(found: ImagedDifference, folder: Path, target: int) -> float:
    """The challenge's score of the labels of an image of a target."""
    assert found.labels is not None
    return challenge_score(found.labels, scipy.io.loadmat(folder / f"true{target}.mat")["truth"])


CASE = Case(
    "ktc2023",
    "the Kuopio Tomography Challenge's score table, on measured data",
    run,
    4,
    page=("docs/explanation/methods.md", "ktc2023"),
    timed=False,
)
