"""The Kuopio Tomography Challenge 2023 on its four training targets: `python -m benchmarks.cases.ktc2023 [FOLDER]`.

Difficulty level l leaves out electrodes 1 to 2(l - 1), as injectors and as meters; the seven levels are made from the
complete data by masking. One setting for all: total variation, jeit's defaults.
"""

import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.io

from benchmarks.harness.machine import heading
from jeit.data import read
from jeit.image import Raster, challenge_score, segment
from jeit.imaging.preparation import prepare_difference
from jeit.inverse import TotalVariation, reconstruct

LEVELS = range(1, 8)
TARGETS = range(1, 5)


def scores(folder: Path, num_points: int = 1600, levels=LEVELS, report=print) -> np.ndarray:
    """Scores (levels, targets)."""
    reference = read(folder / "ref.mat")
    table = np.zeros((len(levels), len(TARGETS)))
    prepared = prepare_difference(read(folder / "data1.mat"), reference, contact="common", num_points=num_points)
    model, background = prepared.model, prepared.calibration.conductivity
    raster = Raster.create(model.mesh, extent=(-0.115, 0.115, -0.115, 0.115))
    empty = model.voltages(background)
    for row, level in enumerate(levels):
        gone = list(range(2 * (level - 1)))
        for column, target in enumerate(TARGETS):
            frame = read(folder / f"data{target}.mat")
            mask = np.array(frame.mask[0] & reference.mask[0])
            if gone:
                mask &= np.asarray(frame.protocol.mask_without(gone))
            difference = jnp.where(mask, frame.filled()[0] - reference.filled()[0], 0)
            start = time.perf_counter()
            found = reconstruct(
                model, empty + difference, background,
                prior=TotalVariation(), noise=prepared.deviation, mask=mask, max_steps=100,
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


def markdown(table: np.ndarray, levels=LEVELS) -> str:
    """The score table."""
    lines = ["| level | " + " | ".join(f"target {t}" for t in TARGETS) + " | mean |", "|---" * (len(TARGETS) + 2) + "|"]
    for level, row in zip(levels, table, strict=True):
        lines.append(f"| {level} | " + " | ".join(f"{value:.3f}" for value in row) + f" | **{row.mean():.3f}** |")
    lines.append(f"| all |{' |' * len(TARGETS)} **{table.mean():.3f}** |")
    return "\n".join(lines)


def main() -> None:
    """Print the table for the data in FOLDER."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data/ktc2023")
    if not (folder / "ref.mat").is_file():
        raise SystemExit(f"{folder} does not hold the challenge's training data (ref.mat, data1.mat ... true4.mat).")
    table = scores(folder)
    print("\nKTC2023, training targets, score per level\n", *heading(), "", markdown(table), sep="\n")


if __name__ == "__main__":
    main()
