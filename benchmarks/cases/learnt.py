"""Speed of learnt skins: training, prediction of one frame and of many, beside scikit-learn's own estimators.

Presses are simulated on a disk with 16 electrodes, 208 channels, on a mesh finer than that of the images. Each method
learns positions from 2,000 presses, and predicts 10,000 frames together and one frame alone: from voltages to positions
with their standard deviations, with a check for dead channels and unusual frames. scikit-learn's estimators predict
positions only, from standardised changes.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say, timed
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch import LearntSkin, Presses
from jeit.touch.learnt.regression import METHODS
from jeit.touch.simulate import DiscIndenter, Press, PressedSkin, material

RADIUS, FINGER, LOADS = 0.05, 0.016, (0.5, 8.0)  # m; a disc's diameter, m; N
PRESSES, FRAMES, FRESH = 2000, 10_000, 500
FIT, ONE, MANY = 60.0, 1e-3, 0.2  # limits, seconds
HEADER = ["method", "features", "learnt in", "one frame"]


def run(options: Options) -> Result:
    """Measure every method separately, then all methods together, without and with a model of the skin."""
    number, many = (60, 300) if options.quick else (PRESSES, FRAMES)
    model, presses, frames, reference, right = _skin(number, 100 if options.quick else FRESH)
    asked_of = np.resize(frames, (many, frames.shape[1]))
    rows, ones, lots, fits = [], {}, {}, {}
    methods = ("ridge",) if options.quick else (*[one for one in METHODS if one != "auto"], "auto")
    for method, known in [*((one, None) for one in methods), ("auto", model)]:
        start = time.perf_counter()
        skin = LearntSkin.fit(presses, method=method, model=known)
        name = method if known is None else f"{method}, model known"
        fits[name] = time.perf_counter() - start
        ones[name] = _one(lambda frame, skin=skin: skin.predict(frame, reference), frames)
        lots[name] = timed(lambda skin=skin: skin.predict(asked_of, reference).position, 5).median
        estimated = skin.predict(frames, reference).position
        error = float(np.nanmean(np.linalg.norm(estimated - right, axis=1)))
        learnt, _, form = skin.standing["place"].method.partition(" on ")
        label = form if method == learnt else skin.standing["place"].method
        rows.append([name, label, *map(duration, (fits[name], ones[name], lots[name])), f"{1e3 * error:.2f} mm"])
        say(" | ".join(rows[-1]))
    rows += _rivals(presses, asked_of, frames, reference, right)
    tables = [Table([*HEADER, f"{many:,} frames", "error, mean"], rows)]
    if options.quick:
        return Result(tables)
    fit, one, lot = (max(values, key=values.get) for values in (fits, ones, lots))
    asked = [
        judged(f"learning, auto: ≤ {FIT:.0f} s", f"{duration(fits[fit])} ({fit})", fits[fit] <= FIT),
        judged("one frame, every method: ≤ 1 ms", f"{duration(ones[one])} ({one})", ones[one] <= ONE),
        judged(f"{FRAMES:,} frames, every method: ≤ 0.2 s", f"{duration(lots[lot])} ({lot})", lots[lot] <= MANY),
    ]
    return Result(tables, asked)


def _skin(number: int, fresh: int):
    """A model, presses simulated on a finer model, new frames, the reference (channels,), and the positions (frames, 2)
    of the new frames in metres."""
    electrodes = BoundaryElectrodes(ring(RADIUS, 16), width=0.008, contact_impedance=300.0)
    model, fine = (ForwardModel(Disk(RADIUS).mesh(num_points=n), electrodes, adjacent(16)) for n in (400, 2500))
    skin, rng = PressedSkin(jax.random.key(0), fine, material("velostat")), np.random.default_rng(0)
    reference = skin.frames(jax.random.key(1), [()] * 20).mean(axis=0)
    distance, angle = (
        0.9 * RADIUS * np.sqrt(rng.uniform(size=number + fresh)),
        rng.uniform(0, 2 * np.pi, number + fresh),
    )
    places = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    loads = np.exp(rng.uniform(*np.log(LOADS), number + fresh))
    drawn = [Press(DiscIndenter(FINGER), load, place) for load, place in zip(loads, places, strict=True)]
    frames = np.asarray(skin.frames(jax.random.key(2), drawn))
    presses = Presses.create(frames[:number], reference=reference, positions=places[:number])
    return model, presses, frames[number:], reference, places[number:]


def _one(predict: Callable[[np.ndarray], Any], frames: np.ndarray) -> float:
    """Median seconds for the prediction of one frame."""
    spent = []
    for frame in frames[:300]:
        start = time.perf_counter()
        predict(frame[None])
        spent.append(time.perf_counter() - start)
    return statistics.median(spent)


def _rivals(presses: Presses, asked_of, frames, reference, right) -> list[list[str]]:
    """Table rows of scikit-learn's ridge regression, nearest neighbours and random forest, with scikit-learn's
    defaults."""
    from sklearn.ensemble import RandomForestRegressor
    from sklearn.linear_model import RidgeCV
    from sklearn.neighbors import KNeighborsRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    rows = []
    for name, estimator in (
        ("ridge regression", RidgeCV(np.logspace(-8, 6, 29))),
        ("nearest neighbours", KNeighborsRegressor(weights="distance")),
        ("random forest", RandomForestRegressor(random_state=0, n_jobs=-1)),
    ):
        start = time.perf_counter()
        learnt = make_pipeline(StandardScaler(), estimator).fit(presses.frames - reference, presses.positions)
        spent = time.perf_counter() - start
        one = _one(lambda frame, learnt=learnt: learnt.predict(frame - reference), frames)
        lot = timed(lambda learnt=learnt: learnt.predict(asked_of - reference), 3).median
        error = float(np.linalg.norm(learnt.predict(frames - reference) - right, axis=1).mean())
        rows.append(
            [f"scikit-learn, {name}", "standardised", *map(duration, (spent, one, lot)), f"{1e3 * error:.2f} mm"]
        )
        say(" | ".join(rows[-1]))
    return rows


CASE = Case("learnt", "skins that learn: seconds to learn, to predict one frame, and many", run, 5)
