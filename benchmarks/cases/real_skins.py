"""Skins that other groups have built and recorded: learnt from the recordings, for positions of touches and for pressed
keys.

Recordings are public, at github.com/lorcan2440/EIT_Touch_Sensor (one and two fingers on gelatine),
github.com/DSHardman/WeightedActivationMaps (a probe on a hydrogel) and github.com/DSHardman/HandProbing (six keys, and
places on a hand). The recordings are searched for under `--data FOLDER`. Models are trained on the first 80 % of the
time and tested on the last 20 %, and compared with ridge regression on raw differences, and with logistic regression on
raw and standardised differences.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io

from benchmarks.harness.case import NOT_MEASURED, Asked, Case, Options, Result, Table, judged
from benchmarks.harness.machine import ROOT
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say
from jeit.touch import LearntSkin, Presses, Touches

LEARNT = 0.8
# Limits: maximum fraction of the error of ridge regression, and minimum percentage points above logistic regression.
PLACES, KEYS = 0.75, 5.0
WHERE = [
    "skin",
    "presses",
    "channels",
    "learnt",
    "error, mean",
    "median",
    "ridge",
    "of ridge's",
    "within 1 and 1.96 std",
]
WHICH = ["skin", "presses", "channels", "learnt", "keys right", "patterns right", "logistic, raw", "standardised"]


@dataclass(frozen=True)
class Recording:
    """Recording of N frames (N, M) of M channels, the reference or None, and positions of K fingers (N, K, 2) in
    metres, or K keys (N, K)."""

    name: str
    frames: np.ndarray
    reference: np.ndarray | None
    places: np.ndarray | None = None
    keys: np.ndarray | None = None

    @property
    def changes(self) -> np.ndarray:
        return self.frames if self.reference is None else self.frames - self.reference


def run(options: Options) -> Result:
    """Learn and test every available recording; nothing without recordings."""
    better, ahead = f"error ≤ {PLACES:g}× ridge's", f"≥ {KEYS:g} points above logistic regression on raw changes"
    asked = [f"places: {better}", f"keys: {ahead}"]
    folder = options.data or Path(os.environ.get("JEIT_DATA", ROOT.parent / "shared" / "data"))
    found = [] if options.quick else list(recordings(folder))
    if not found:
        note = "no recording is there, or this is a quick run: clone the repositories, and give --data FOLDER"
        return Result([Table(WHERE, [])], [Asked(one, "–", NOT_MEASURED) for one in asked], [note])
    where, which, verdicts = [], [], []
    for one in found:
        if one.places is not None:
            row, ratio = _places(one)
            where.append(row)
            verdicts.append(judged(f"{one.name}: {better}", f"{ratio:.2f}×", ratio <= PLACES))
        else:
            row, points = _keys(one)
            which.append(row)
            text = f"{points[0]:+.1f}, whole {points[1]:+.1f}"
            verdicts.append(judged(f"{one.name}: {ahead}", text, min(points) >= KEYS))
        say(" | ".join(row))
    return Result([Table(WHERE, where), Table(WHICH, which)], verdicts)


def recordings(folder: Path) -> Iterator[Recording]:
    """All recordings under a folder."""
    for path in sorted(folder.rglob("EIT_Data_Gelatin_*_finger*_dof*.xlsx")):
        named = re.search(r"(\d)_finger.*- (\w+)", path.stem)
        if named:
            yield _gelatine(path, f"gelatine {named[2]}, fingers: {named[1]}")
    for path in sorted(folder.rglob("MultiTouch/ConstructionData.mat")):
        held = scipy.io.loadmat(path)
        places = held["positions"][:, None, :2]
        yield Recording("hydrogel, a probe", held["responsedowns"], held["responseups"], places)
    for path in sorted(folder.rglob("6PointProbing/channelresponses/Batch*.mat")):
        held = scipy.io.loadmat(path)
        yield Recording(f"six keys, {path.stem}", held["afters"], held["befores"], keys=held["patterns"].astype(bool))
    for path in sorted(folder.rglob("Touch500Data.mat")):
        held = scipy.io.loadmat(path)
        yield Recording("a hand", held["responses"].astype(float), None, 1e-3 * held["targetpositions"][:, None])


def _gelatine(path: Path, name: str) -> Recording:
    """Recording on gelatine from a spreadsheet with voltage changes, and with positions in metres: x of one or two
    fingers, then y."""
    from openpyxl import load_workbook

    book = load_workbook(path, read_only=True)
    sheets = [list(book[sheet].iter_rows(min_row=2, values_only=True)) for sheet in ("Voltages", "Positions")]
    frames, places = (
        np.array([[np.nan if one is None else one for one in row] for row in rows], float) for rows in sheets
    )
    places = places.reshape(len(places), 2, 2).transpose(0, 2, 1)
    there = np.isfinite(places).all(axis=(0, 2))
    # Each row contains the frame of the preceding press: with the position in the same row, no prediction is better
    # than chance.
    return Recording(name, frames[1:], None, places[:-1, there])


def _cut(one: Recording) -> tuple[slice, slice]:
    number = int(LEARNT * len(one.frames))
    return slice(number), slice(number, None)


def _presses(one: Recording, rows: slice, **answers) -> Presses:
    reference = None if one.reference is None else one.reference[rows]
    return Presses.create(one.frames[rows], reference=reference, name=one.name, **answers)


def _ask(skin: LearntSkin, one: Recording, rows: slice) -> Touches:
    return skin.predict(one.frames[rows], None if one.reference is None else one.reference[rows])


def _places(one: Recording) -> tuple[list[str], float]:
    """A table row for positions, and the ratio of jeit's error to that of ridge regression. Each finger has its own
    model."""
    from sklearn.linear_model import RidgeCV

    learnt, asked = _cut(one)
    start, errors, theirs, ratios = time.perf_counter(), [], [], []
    for finger in np.moveaxis(one.places, 1, 0):
        skin = LearntSkin.fit(_presses(one, learnt, positions=finger[learnt]))
        prediction, right = _ask(skin, one, asked), finger[asked]
        errors.append(np.linalg.norm(prediction.position - right, axis=1))
        ratios.append(np.abs(prediction.position - right) / prediction.position_std)
        ridge = RidgeCV(np.logspace(-8, 6, 29)).fit(one.changes[learnt], finger[learnt])
        theirs.append(np.linalg.norm(ridge.predict(one.changes[asked]) - right, axis=1))
    spent = time.perf_counter() - start
    # A frame without a prediction counts as located at the centre of the skin.
    error, plain, ratio = (np.concatenate(each) for each in (errors, theirs, ratios))
    guess = np.linalg.norm(one.places - one.places[learnt].mean(axis=0), axis=-1).mean()
    error = np.where(np.isfinite(error), error, guess)
    row = [one.name, str(len(one.frames)), str(one.frames.shape[1]), duration(spent)]
    row += [f"{1e3 * value:.1f} mm" for value in (error.mean(), np.median(error), plain.mean())]
    held = " and ".join(f"{100 * np.nanmean(ratio < times):.0f} %" for times in (1, 1.96))
    return [*row, f"{error.mean() / plain.mean():.2f}×", held], float(error.mean() / plain.mean())


def _keys(one: Recording) -> tuple[list[str], tuple[float, float]]:
    """A table row for keys, and the percentage points by which jeit is better than logistic regression on raw
    differences, for single keys and for whole patterns of keys.
    """
    learnt, asked = _cut(one)
    start = time.perf_counter()
    skin = LearntSkin.fit(_presses(one, learnt, touched=one.keys[learnt]))
    spent = time.perf_counter() - start
    ours = _right(_ask(skin, one, asked).touched, one.keys[asked])
    mean, deviation = one.changes[learnt].mean(axis=0), one.changes[learnt].std(axis=0)
    standard = (one.changes - mean) / np.where(deviation > 0, deviation, np.inf)
    raw, scaled = (_right(_logistic(values, one, learnt, asked), one.keys[asked]) for values in (one.changes, standard))
    row = [one.name, str(len(one.frames)), str(one.frames.shape[1]), duration(spent)]
    row += [f"{ours[0]:.1f} %", f"{ours[1]:.1f} %", *(f"{key:.1f} % / {whole:.1f} %" for key, whole in (raw, scaled))]
    return row, (ours[0] - raw[0], ours[1] - raw[1])


def _logistic(values: np.ndarray, one: Recording, learnt: slice, asked: slice) -> np.ndarray:
    from sklearn.linear_model import LogisticRegression

    def key(answers: np.ndarray) -> np.ndarray:
        return LogisticRegression(max_iter=1000).fit(values[learnt], answers).predict(values[asked])

    return np.column_stack([key(answers) for answers in one.keys[learnt].T])


def _right(predicted: np.ndarray, keys: np.ndarray) -> tuple[float, float]:
    """Percentages of correctly predicted keys, and of correctly predicted patterns of all keys."""
    return 100 * float(np.mean(predicted == keys)), 100 * float(np.mean((predicted == keys).all(axis=1)))


CASE = Case("real_skins", "skins that others built, learnt from their recordings", run, 5, timed=False)
