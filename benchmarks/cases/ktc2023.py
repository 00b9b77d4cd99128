"""The Kuopio Tomography Challenge 2023 on its four training targets.

Difficulty level l leaves out electrodes 1 to 2(l - 1), as injectors and as meters; the seven levels are made from the
complete data by masking. One setting for all: total variation, jeit's defaults.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.io

from benchmarks.harness.case import NOT_MEASURED, Asked, Case, Headline, Options, Result, Table, judged
from benchmarks.harness.machine import ROOT
from benchmarks.harness.timing import say
from jeit.data import read
from jeit.image import Raster, segment
from jeit.image.score import challenge_score
from jeit.imaging.preparation import prepare_difference
from jeit.inverse import TotalVariation, reconstruct
from jeit.inverse.nonlinear import GaussNewton

LEVELS, TARGETS = range(1, 8), range(1, 5)
# The mean score at level 1.
SCORE = 0.85


def run(options: Options) -> Result:
    """All levels of all targets; one of each in a quick run. Without the challenge's data, nothing."""
    asked = f"mean score at level 1: ≥ {SCORE}"
    folder = _folder(options.data)
    if folder is None:
        note = "the challenge's training data (ref.mat, data1.mat … true4.mat) are not there: give --data FOLDER"
        return Result([Table(["level", "mean"], [])], [Asked(asked, "–", NOT_MEASURED)], [note])
    levels, targets, nodes = (LEVELS[:1], TARGETS[:1], 400) if options.quick else (LEVELS, TARGETS, 1600)
    table = scores(folder, nodes, levels, targets, say)
    rows = [
        [str(level), *(f"{value:.3f}" for value in row), f"**{row.mean():.3f}**"]
        for level, row in zip(levels, table, strict=True)
    ]
    rows.append(["all", *len(targets) * [""], f"**{table.mean():.3f}**"])
    header = ["level", *(f"target {target}" for target in targets), "mean"]
    first = float(table[0].mean())
    job = f"Kuopio Tomography Challenge 2023, {len(targets)} training targets, score of level 1"
    headline = Headline(job, f"{first:.3f}", accuracy=f"{table.mean():.3f} over all {len(levels)} levels")
    return Result([Table(header, rows)], [judged(asked, f"{first:.3f}", first >= SCORE)], headline=headline)


def _folder(data: Path | None) -> Path | None:
    """Where the challenge's data are: the folder given, or `ktc2023` in it, in JEIT_DATA or in ../shared/data."""
    named = data or Path(os.environ.get("JEIT_DATA", ROOT.parent / "shared" / "data"))
    return next((path for path in (named, named / "ktc2023") if (path / "ref.mat").is_file()), None)


def scores(folder: Path, num_points: int = 1600, levels=LEVELS, targets=TARGETS, report=print) -> np.ndarray:
    """Scores (levels, targets)."""
    reference = read(folder / "ref.mat")
    table = np.zeros((len(levels), len(targets)))
    prepared = prepare_difference(read(folder / "data1.mat"), reference, contact="common", num_points=num_points)
    model, background = prepared.model, prepared.calibration.conductivity
    raster = Raster.create(model.mesh, extent=(-0.115, 0.115, -0.115, 0.115))
    empty = model.voltages(background)
    for row, level in enumerate(levels):
        gone = list(range(2 * (level - 1)))
        for column, target in enumerate(targets):
            frame = read(folder / f"data{target}.mat")
            mask = np.array(frame.mask[0] & reference.mask[0])
            if gone:
                mask &= np.asarray(frame.protocol.mask_without(gone))
            difference = jnp.where(mask, frame.filled()[0] - reference.filled()[0], 0)
            start = time.perf_counter()
            found = reconstruct(
                model, empty + difference, background,
                prior=TotalVariation(), noise=prepared.relative_noise, mask=mask, solver=GaussNewton(max_steps=100),
            )  # fmt: skip
            image = raster.sample(jnp.log(found.conductivity / background))
            seconds = time.perf_counter() - start
            labels = segment(np.asarray(image))
            truth = scipy.io.loadmat(folder / f"true{target}.mat")["truth"]
            table[row, column] = challenge_score(labels, truth)
            report(
                f"level {level}, target {target}: {table[row, column]:.3f}  ({found.status}, {found.iterations} "
                f"steps, {seconds:.1f} s)"
            )
    return table


CASE = Case(
    "ktc2023",
    "the Kuopio Tomography Challenge's score table, on measured data",
    run,
    4,
    page=("docs/how-to-choose-a-method.md", "ktc2023"),
    timed=False,
)
