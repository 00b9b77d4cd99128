"""Six gestures on a sheet, classified by LogitBoost and other methods, beside Silvera Tawil et al. (2011). All data are
simulated.

The simulation and the differences between people are in `problems/touching_people.py` and `jeit.touch.simulate.people`.
Comparable with the paper are the finding that one person's gestures are classified better than many people's, and the
pairs of gestures that are confused, but not percentages. The paper's folds are random, so that every person is in the
training data. Here, people are also held out from the training data.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness.case import Asked, Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say
from benchmarks.problems.touching_people import Sheet
from jeit.data import GestureSet
from jeit.touch import TouchImages, TouchWatch, WatchedFrame, learn_gestures
from jeit.touch.gestures import GestureModel, StreamTouch
from jeit.touch.gestures.gesture_classifiers import (
    FEATURE_FORMS,
    GESTURE_CLASSIFIERS,
    feature_forms,
    held_out_odds,
    person_folds,
    random_folds,
)
from jeit.touch.reports.touch_watch import WrittenWatch, draw_watch
from jeit.touch.simulate.people import GESTURES

FOLDS = 15
# The paper's percentages of correctly classified gestures, for one person and for 35 people.
PAPER = {"one person": (85, 83, 97, 93, 93, 97), "many people": (84, 61, 89, 58, 65, 87)}
PAIRS = (("tap", "pat"), ("pat", "tap"), ("stroke", "scratch"), ("scratch", "stroke"))
# The paper's percentages of the first gesture of each pair that are classified as the second.
CONFUSED = {"one person": (14, 15, 7, 7), "many people": (15, 27, 37, 34)}
THEIRS, HIS = "logit-boost", "seven"
MINUTE = 60.0  # number of gestures in the stream
# Folder in which simulated gesture sets are kept for later runs.
STORE = Path(tempfile.gettempdir()) / "jeit-gestures"


@dataclass
class Experiment:
    """Detected touches, the numbers of their true gestures (`right`) and persons, and the number of recordings without
    a detected touch (`missed`)."""

    name: str
    touches: list[StreamTouch]
    right: np.ndarray
    person: np.ndarray
    missed: int
    cut_off: int

    @classmethod
    def of(cls, name: str, sheet: Sheet, made: GestureSet) -> Experiment:
        """Detect the touches in a gesture set."""
        found = sheet.touches(made)
        there = [number for number, one in enumerate(found) if one is not None]
        touches = [one for one in found if one is not None]
        right = np.array([GESTURES.index(made.gesture[number]) for number in there])
        cut_off = sum(not one.whole for one in touches)
        return cls(name, touches, right, made.person[there], len(found) - len(there), cut_off)

    def confusion(self, method: str, form: str, folds: np.ndarray) -> np.ndarray:
        """Confusion matrix (6, 6): percentages of each true gesture (row) that are classified as each gesture
        (column)."""
        odds = held_out_odds(method, FEATURE_FORMS[form](self.touches).values, self.right, folds)
        counts = np.zeros((len(GESTURES), len(GESTURES)))
        np.add.at(counts, (self.right, odds.argmax(axis=1)), 1)
        return 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)


def run(options: Options) -> Result:
    """Evaluate every classifier on one person and on many people, held out at random and by person, and time a
    classification."""
    quick = options.quick
    sheet = Sheet(fine=1300, nodes=900) if quick else Sheet()
    sizes = (
        {"one person": (1, 3, 1), "many people": (2, 2, 2)}
        if quick
        else {"one person": (1, 120, 1), "many people": (35, 5, 2)}
    )
    names = (THEIRS, "linear-discriminant") if quick else tuple(GESTURE_CLASSIFIERS)
    folds = 3 if quick else FOLDS
    experiments, sets = {}, {}
    for name, (people, each, seed) in sizes.items():
        say(f"{people} × {each} × {len(GESTURES)} touches are simulated, or read")
        sets[name] = sheet.gestures(people, each, seed, store=None if quick else STORE)
        experiments[name] = Experiment.of(name, sheet, sets[name])
    one, many = experiments.values()
    found, rows = {}, []
    for form in FEATURE_FORMS:
        for method in (one for one in names if form in feature_forms(one)):
            accuracies = []
            for experiment in (one, many):
                at_random = experiment.confusion(method, form, random_folds(experiment.right, folds))
                found[experiment.name, method, form] = at_random
                accuracies.append(at_random.diagonal().mean())
            by_person = many.confusion(method, form, person_folds(many.person))
            found["by person", method, form] = by_person
            rows.append([method, form, *(f"{one:.0f} %" for one in (*accuracies, by_person.diagonal().mean()))])
            say(" | ".join(rows[-1]))
    best = max(
        ((method, form) for method in names for form in feature_forms(method)),
        key=lambda own: found["by person", *own].diagonal().mean(),
    )
    each = [_gestures(name, found[name, THEIRS, HIS], PAPER[name]) for name in experiments]
    each += [_gestures("by person", found["by person", *own]) for own in ((THEIRS, HIS), best)]
    for row, (method, form) in zip(each, ((THEIRS, HIS),) * 3 + (best,), strict=True):
        row.insert(1, f"{method}, {form}")
    pairs = [
        [name, f"{a} as {b}", f"{theirs} %", f"{found[name, THEIRS, HIS][GESTURES.index(a), GESTURES.index(b)]:.0f} %"]
        for name in experiments
        for (a, b), theirs in zip(PAIRS, CONFUSED[name], strict=True)
    ]
    live = _live(sheet, sets["many people"], best, options)
    tables = [
        Table(["experiment", "by", *GESTURES, "mean"], each, "Gestures", _caption(experiments, folds)),
        Table(
            ["experiment", "classified as", "paper", "ours"],
            pairs,
            "Confusions",
            "LogitBoost on the seven features, folds drawn at random; per cent of the gesture.",
        ),
        Table(
            ["classifier", "features", "one person, at random", "many, at random", "many, by person"],
            rows,
            "Classifiers",
            "Mean of the gestures, per cent right; seven: the paper's features; course: those and more of its course; "
            "sequence: all of it.",
        ),
        live.table(),
    ]
    if options.output is not None:
        _draw(options.output, many, best)
    return Result(tables, [] if quick else _asked(found, best, live))


def _gestures(name: str, confusion: np.ndarray, paper: tuple[int, ...] | None = None) -> list[str]:
    """A table row: percentage of correctly classified recordings of each gesture and on average, with the paper's
    percentages in brackets."""
    own = [*confusion.diagonal(), confusion.diagonal().mean()]
    if paper is None:
        return [name, *(f"{value:.0f}" for value in own)]
    return [name, *(f"{value:.0f} ({theirs:.0f})" for value, theirs in zip(own, [*paper, np.mean(paper)], strict=True))]


def _caption(experiments: dict[str, Experiment], folds: int) -> str:
    text = "; ".join(
        f"{name}: {len(one.touches) + one.missed} recordings, {one.missed} without a touch, {one.cut_off} cut off"
        for name, one in experiments.items()
    )
    return f"Per cent right, the paper's in brackets. {folds} folds at random, and each person held out. {text}."


@dataclass
class Live:
    """Results of the classification of a stream with a number of `frames` and `touches`.

    `detected` touches are detected and `right` are classified correctly; `false` is the number of detections without a
    touch. Times in seconds (99th percentiles): `followed`, from a frame to its events; `named`, from the frame after a
    touch to the classification; `after_end`, from the last frame of a touch to the classification. `usual`: median of
    `named`.
    """

    frames: int
    touches: int
    detected: int
    right: int
    false: int
    followed: float
    named: float
    after_end: float
    usual: float

    def table(self) -> Table:
        """The table of all results of the stream."""
        rows = [
            ["touches in the stream, by people who are not in the training data", f"{self.touches}"],
            ["of these detected", f"{self.detected}"],
            ["classified correctly", f"{self.right}"],
            ["detections without a touch", f"{self.false}"],
            ["a frame processed: imaged, segmented (99 % within)", duration(self.followed)],
            ["a touch classified, computing (median)", duration(self.usual)],
            ["a touch classified, computing (99 % within)", duration(self.named)],
            ["a touch classified after its last frame, wait included (99 % within)", duration(self.after_end)],
        ]
        return Table(["what", "measured"], rows, f"A live stream of {self.frames:,} frames at 60 Hz")


def _live(sheet: Sheet, made: GestureSet, best: tuple[str, str], options: Options) -> Live:
    """Classify a stream of four people who are not in the training data, frame by frame."""
    model = learn_gestures(sheet.description, made, method=best[0], form=best[1]).model
    stream = sheet.stream(4, 5 if options.quick else 60, 3, store=None if options.quick else STORE)
    still = stream.voltages[stream.seconds < 1.0]
    watch = TouchWatch.create(TouchImages.prepare(sheet.description, still), model, still, rate=60.0)
    watched = list(watch.follow(zip(stream.seconds.tolist(), stream.voltages, strict=True)))
    touches = [touch for one in watched for touch in one.ended]
    if options.output is not None:
        _draw_timeline(options.output / "timeline.png", watch, watched)
    onset = np.array([one.touch.onset for one in touches])
    own = [np.flatnonzero(np.abs(onset - begin) < 0.25) for begin in stream.onset]
    detected = [(one[0], name) for one, name in zip(own, stream.gesture, strict=True) if one.size]
    named = np.array([one.named.latency for one in watched if one.named is not None] or [np.nan])
    waited = np.array([one.named.named - one.named.touch.offset for one in watched if one.named is not None] or [0.0])
    return Live(
        frames=len(stream.seconds),
        touches=len(stream.onset),
        detected=len(detected),
        right=sum(touches[number].gesture == name for number, name in detected),
        false=len(touches) - len({number for number, _ in detected}),
        followed=float(np.quantile([one.latency for one in watched], 0.99)),
        named=float(np.quantile(named, 0.99)),
        after_end=float(np.quantile(waited + named, 0.99)),
        usual=float(np.median(named)),
    )


def _draw_timeline(path: Path, watch: TouchWatch, watched: list[WatchedFrame]) -> None:
    """Draw the first minute of the stream."""
    shown = [one for one in watched if one.second < MINUTE]
    touches = tuple(touch for one in shown for touch in one.ended)
    seconds, peaks = (np.array([getattr(one, name) for one in shown]) for name in ("second", "peak"))
    draw_watch(WrittenWatch(touches, seconds, peaks, np.zeros(0), {}), watch).savefig(path, dpi=110)


def _draw(output: Path, many: Experiment, best: tuple[str, str]) -> None:
    """Draw confusion matrices of the gestures of many people, with each person held out from the training data."""
    from jeit.touch.plots import plot_confusion

    labels = np.array(GESTURES)[many.right]
    model = GestureModel.fit(many.touches, labels, people=many.person, method=best[0], form=best[1])
    if model.standing is not None:
        right = 100 * np.mean(model.standing.held_out == model.standing.right)
        title = f"Gestures of held-out people: {right:.0f} % right"
        plot_confusion(model.standing, title=title).figure.savefig(output / "gestures.png", dpi=110)


def _asked(found: dict, best: tuple[str, str], live: Live) -> list[Asked]:
    """Checks of the paper's findings that are comparable."""
    one, many = (found[name, THEIRS, HIS] for name in PAPER)
    left_out = found["by person", *best].diagonal().mean()
    asked = [
        judged(
            "one person's gestures are classified better than many people's (91 and 74 %)",
            f"{one.diagonal().mean():.0f} and {many.diagonal().mean():.0f} %",
            one.diagonal().mean() > many.diagonal().mean(),
        )
    ]
    for name, confusion in (("one person", one), ("many people", many)):
        rest = confusion + confusion.T
        order = sorted(((rest[a, b], a, b) for a in range(6) for b in range(a)), reverse=True)[:2]
        detected = {frozenset((GESTURES[a], GESTURES[b])) for _, a, b in order}
        asked.append(
            judged(
                f"{name}: tap and pat, stroke and scratch are confused most",
                "; ".join(f"{GESTURES[b]} and {GESTURES[a]}" for _, a, b in order),
                detected == {frozenset(("tap", "pat")), frozenset(("stroke", "scratch"))},
            )
        )
    return [
        *asked,
        Asked("of held-out people, by the best classifier", f"{left_out:.0f} % ({', '.join(best)})"),
        judged(
            "on a live stream of 10,000 frames at 60 Hz a touch is classified within 50 ms of its end (99 %)",
            f"{duration(live.after_end)} after its last frame, {duration(live.named)} of it computing",
            live.after_end < 0.05,
        ),
    ]


CASE = Case(
    "gestures",
    "six gestures classified by LogitBoost and others, beside the paper's",
    run,
    25,
    page=("docs/explanation/gestures.md", "gestures"),
    pictures=True,
)
