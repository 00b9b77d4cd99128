"""Six gestures on a sheet told apart, by LogitBoost and by others, beside Silvera Tawil et al. (2011); all simulated.

What is simulated, and how people differ, is in `problems/touching_people.py` and `jeit.simulate.people`. To be
compared: that one person's gestures are told better than many people's, and which are taken for each other; not per
cent. The paper's folds are random, so that everybody is learnt from; with people held out nobody is.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness.case import Asked, Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say, timed
from benchmarks.problems.touching_people import Sheet
from jeit.data import GestureSet
from jeit.simulate.people import GESTURES
from jeit.touch.gestures import GestureModel, StreamTouch, TouchStream
from jeit.touch.gestures.gesture_classifiers import (
    FORMS,
    GESTURE_CLASSIFIERS,
    held_out_odds,
    person_folds,
    random_folds,
)

FOLDS = 15
# The paper's: per cent right of each gesture, of one person and of 35.
PAPER = {"one person": (85, 83, 97, 93, 93, 97), "many people": (84, 61, 89, 58, 65, 87)}
PAIRS = (("tap", "pat"), ("pat", "tap"), ("stroke", "scratch"), ("scratch", "stroke"))
# Of those pairs, per cent.
CONFUSED = {"one person": (14, 15, 7, 7), "many people": (15, 27, 37, 34)}
THEIRS, HIS = "logit-boost", "seven"
# Where sets are kept from one run to the next.
STORE = Path(tempfile.gettempdir()) / "jeit-gestures"


@dataclass
class Experiment:
    """Touches (n,) by their numbers of gesture and person; how many recordings had none."""

    name: str
    touches: list[StreamTouch]
    right: np.ndarray
    person: np.ndarray
    missed: int
    cut_off: int

    @classmethod
    def of(cls, name: str, sheet: Sheet, made: GestureSet) -> Experiment:
        """What is found in a set."""
        found = sheet.touches(made)
        there = [number for number, one in enumerate(found) if one is not None]
        touches = [one for one in found if one is not None]
        right = np.array([GESTURES.index(made.gesture[number]) for number in there])
        cut_off = sum(not one.whole for one in touches)
        return cls(name, touches, right, made.person[there], len(found) - len(there), cut_off)

    def confusion(self, method: str, form: str, folds: np.ndarray) -> np.ndarray:
        """Shares (6, 6), per cent, of each gesture that were told as each."""
        odds = held_out_odds(method, FORMS[form](self.touches).values, self.right, folds)
        counts = np.zeros((len(GESTURES), len(GESTURES)))
        np.add.at(counts, (self.right, odds.argmax(axis=1)), 1)
        return 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)


def run(options: Options) -> Result:
    """One person and many, by every classifier, held out at random and by person; how quick an answer is."""
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
    for form in FORMS:
        for method in names:
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
        ((method, form) for method in names for form in FORMS),
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
    answer, end = _seconds(many, sheet, sets["many people"], *best)
    tables = [
        Table(["experiment", "by", *GESTURES, "mean"], each, "Gestures", _caption(experiments, folds)),
        Table(
            ["experiment", "told", "paper", "ours"],
            pairs,
            "Taken for each other",
            "LogitBoost on the seven features, folds drawn at random; per cent of the gesture.",
        ),
        Table(
            ["classifier", "features", "one person, at random", "many, at random", "many, by person"],
            rows,
            "Classifiers",
            "Mean of the gestures, per cent right; seven: the paper's features; course: those and more of its course.",
        ),
        Table(
            ["what", "a time"],
            [["a frame followed: imaged, cut", duration(end)], ["a touch told", duration(answer)]],
            "Times",
        ),
    ]
    if options.output is not None:
        _draw(options.output, many, best)
    return Result(tables, [] if quick else _asked(found, best, end + answer))


def _gestures(name: str, confusion: np.ndarray, paper: tuple[int, ...] | None = None) -> list[str]:
    """Right of each gesture and on average, the paper's in brackets."""
    own = [*confusion.diagonal(), confusion.diagonal().mean()]
    if paper is None:
        return [name, *(f"{value:.0f}" for value in own)]
    return [name, *(f"{value:.0f} ({theirs:.0f})" for value, theirs in zip(own, [*paper, np.mean(paper)], strict=True))]


def _caption(experiments: dict[str, Experiment], folds: int) -> str:
    said = "; ".join(
        f"{name}: {len(one.touches) + one.missed} recordings, {one.missed} without a touch, {one.cut_off} cut off"
        for name, one in experiments.items()
    )
    return f"Per cent right, the paper's in brackets. {folds} folds at random, and each person held out. {said}."


def _seconds(many: Experiment, sheet: Sheet, made: GestureSet, method: str, form: str) -> tuple[float, float]:
    """Of telling one touch, and of following one frame."""
    labels = np.array(GESTURES)[many.right]
    model = GestureModel.fit(many.touches, labels, people=many.person, method=method, form=form)
    longest = max(many.touches, key=lambda one: len(one.course))
    answer = timed(lambda: model.predict([longest]), 20).median
    _, changes = made.changes(0)
    stream = TouchStream(sheet.level(made))
    for frame in range(3):
        stream = stream.follow(frame / 60, np.asarray(sheet.linear.image(changes[len(changes) // 3])))
    follow = timed(lambda: stream.follow(1.0, np.asarray(sheet.linear.image(changes[0]))), 20).median
    return answer, follow


def _draw(output: Path, many: Experiment, best: tuple[str, str]) -> None:
    """Confusions of many people's gestures, each person held out."""
    from jeit.plot import plot_confusion

    labels = np.array(GESTURES)[many.right]
    model = GestureModel.fit(many.touches, labels, people=many.person, method=best[0], form=best[1])
    if model.standing is not None:
        plot_confusion(model.standing).figure.savefig(output / "gestures.png", dpi=150)


def _asked(found: dict, best: tuple[str, str], latency: float) -> list[Asked]:
    """What the paper finds, as far as it can be compared."""
    one, many = (found[name, THEIRS, HIS] for name in PAPER)
    left_out = found["by person", *best].diagonal().mean()
    asked = [
        judged(
            "one person's gestures are told better than many people's (91 and 74 %)",
            f"{one.diagonal().mean():.0f} and {many.diagonal().mean():.0f} %",
            one.diagonal().mean() > many.diagonal().mean(),
        )
    ]
    for name, confusion in (("one person", one), ("many people", many)):
        rest = confusion + confusion.T
        order = sorted(((rest[a, b], a, b) for a in range(6) for b in range(a)), reverse=True)[:2]
        told = {frozenset((GESTURES[a], GESTURES[b])) for _, a, b in order}
        asked.append(
            judged(
                f"{name}: tap and pat, stroke and scratch are those most taken for each other",
                "; ".join(f"{GESTURES[b]} and {GESTURES[a]}" for _, a, b in order),
                told == {frozenset(("tap", "pat")), frozenset(("stroke", "scratch"))},
            )
        )
    return [
        *asked,
        Asked("of people who were not learnt from, by the best classifier", f"{left_out:.0f} % ({', '.join(best)})"),
        judged("a touch is told within 50 ms of the frame that ends it", duration(latency), latency < 0.05),
    ]


CASE = Case(
    "gestures",
    "six gestures told apart, by LogitBoost and others, beside the paper's",
    run,
    12,
    timed=False,
)
