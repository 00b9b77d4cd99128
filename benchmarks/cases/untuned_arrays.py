"""jeit's defaults for acoustic localisation on 200 random arrays of microphones, compared with each decay model and a
plain fit.

The decay of sound, echoes from the edges, gains, noise, number and positions of microphones, and accuracy and positions
of taps are all drawn by a generator that uses none of jeit's decay models (`benchmarks/problems/simulated_arrays.py`).
jeit's defaults were set on arrays of other seeds and other ranges (`DEVELOPMENT` in that module). A second table has
arrays on which sound decays increasingly faster than a / (r² + b).
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness.case import Asked, Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems.located_arrays import Located, located_by_each, plainly_located
from benchmarks.problems.simulated_arrays import REPORTED, draw_array, steep_array
from jeit.acoustic.calibration.calibrate import AUTO
from jeit.acoustic.decay import DECAY_MODELS

# Seed of the first array, and number of arrays.
SEED, ARRAYS = 70_000, 200
# Maximum median error in metres of the plain fit for an array that jeit must not refuse, and maximum excess of jeit's
# median error over that of the best fixed model, as a fraction.
WITHIN, WORSE = 0.01, 0.1
LENGTHS = (0.035, 0.05, 0.065, 0.08)
PLAIN = "plain fit"
NAMES = (PLAIN, *DECAY_MODELS, AUTO)


def locate_by_each(array) -> dict[str, Located]:
    """The results of each method for an array, by name of the method."""
    return {PLAIN: plainly_located(array)} | located_by_each(array)


def medians(found: list[dict[str, Located]], name: str) -> np.ndarray:
    """Median errors over the touches of each array, metres, for the method `name`; infinite if it refuses the array."""
    return np.array([one[name].median for one in found])


def arrays_table(found: list[dict[str, Located]]) -> Table:
    """A table with a row for each method: refused arrays, errors, and coverage of ellipses among located touches."""
    header = ["decay model", "refused", "of those the plain fit locates", "median, mm", "9 of 10 arrays, mm", "best"]
    header += ["in the 68 % ellipse", "in the 95 % ellipse", "silence taken for touch"]
    least = np.min([medians(found, name) for name in DECAY_MODELS], axis=0)
    plain = medians(found, PLAIN) < WITHIN
    rows = []
    for name in NAMES:
        mine = medians(found, name)
        refused = np.array([bool(one[name].message) for one in found])
        row = [name, str(refused.sum()), str((refused & plain).sum())]
        row += [f"{1e3 * np.quantile(mine, part, method='inverted_cdf'):.1f}" for part in (0.5, 0.9)]
        row += [f"{100 * np.mean(mine <= least):.0f} %"]
        if name == PLAIN:
            rows.append([*row, "", "", ""])
            continue
        held = [100 * np.nanmean([one[name].held(which) for one in found]) for which in (0, 1)]
        quiet = 100 * np.mean([one[name].silence for one in found])
        rows.append([*row, *(f"{share:.0f} %" for share in held), f"{quiet:.2g} %"])
    return Table(header, rows, f"{len(found)} arrays", "Median: of the medians of 40 touches of each array.")


def steep_table(lengths, seeds) -> Table:
    """A table of median errors with 25 microphones under 200 × 200 mm, for an array of each attenuation
    length and seed."""
    rows = []
    for length in lengths:
        found = [locate_by_each(steep_array(length, seed)) for seed in seeds]
        chosen = ", ".join(dict.fromkeys(one[AUTO].decay for one in found))
        figures = [f"{1e3 * np.mean(medians(found, name)):.1f}" for name in NAMES]
        rows.append([f"{1e3 * length:.0f} mm", *figures, chosen])
        say(" | ".join(rows[-1]))
    return Table(["attenuation length", *(f"{name}, mm" for name in NAMES), "auto takes"], rows)


def run(options: Options) -> Result:
    """Compute both tables, and check the required figures."""
    # A quick run leaves out steep arrays, which a test locates.
    number, lengths, seeds = (1, (), (0,)) if options.quick else (ARRAYS, LENGTHS, (0, 1))
    found = []
    for k in range(number):
        found.append(locate_by_each(draw_array(REPORTED, SEED + k)))
        if (k + 1) % 20 == 0:
            say(f"{k + 1} arrays, median {1e3 * np.median(medians(found, AUTO)):.1f} mm")
    return Result([arrays_table(found), steep_table(lengths, seeds)], asked(found))


def asked(found: list[dict[str, Located]]) -> list[Asked]:
    """Checks that no array is refused that the plain fit locates, and that the median error is close to that of the
    best fixed model."""
    lost = sum(bool(one[AUTO].message) and one[PLAIN].median < WITHIN for one in found)
    mine = np.median(medians(found, AUTO))
    fixed = {name: float(np.median(medians(found, name))) for name in DECAY_MODELS}
    best = min(fixed, key=lambda name: fixed[name])
    beside = f"{1e3 * mine:.2f} mm; {best} {1e3 * fixed[best]:.2f} mm"
    return [
        judged("auto refuses no array that a plain fit locates within 10 mm", f"{lost} refused", lost == 0),
        judged("auto's median ≤ 1.1 × the best fixed model's", beside, bool(mine <= (1 + WORSE) * fixed[best])),
    ]


CASE = Case(
    "untuned_arrays",
    "touches located by sound with the defaults, on 200 arrays drawn at random",
    run,
    20,
    timed=False,
)
