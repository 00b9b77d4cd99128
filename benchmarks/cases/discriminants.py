"""Which square of a fabric is touched, by nine classifiers, after Russo et al. (2017), on a simulated fabric.

Squares of 13 and 17 cm, 16 or 8 electrodes, opposite drive; a finger presses the squares of a chess board of 15 or
10 mm with 10 to 100 kPa, within 1 mm of their middles. Six repetitions of twenty presses, each read as medians of 160
samples, teach; twenty a day later test, when conductivity and contacts have drifted, as they are and with a reference
taken anew. All this was fixed before accuracies were looked at. To be compared: the order of methods, what grows and
falls, where the quadratic discriminant fails; not per cent.
"""

from __future__ import annotations

import time
from dataclasses import replace

import jax
import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import perimeter
from jeit.mesh import Rectangle
from jeit.protocol import opposite
from jeit.simulate import Disc, Press, PressedSkin, material
from jeit.touch.learnt.classifiers import CLASSIFIERS, log_odds

REPETITIONS, PRESSES, TESTS, SAMPLES = 6, 20, 20, 160
MINUTES, DAY = 10.0, 86400.0  # between repetitions; and to the test, seconds
PRESSURE, JITTER, CONTACT = (10e3, 100e3), 1e-3, 0.6  # Pa; m; of a finger's width, beside the target's
# Observations a class; methods that take minutes of the largest.
SIZES, SLOW = (24, 240, 2400), ("linear-svm", "quadratic-svm", "boosted-trees", "bagged-trees")
# The paper's: accuracies on folds of the training presses, and on tests a day later, per cent.
TRAINED = {
    "tree": (78, 79, 72),
    "linear-discriminant": (92, 94, 94),
    "quadratic-discriminant": (67, 99, 100),
    "linear-svm": (84, 100, 98),
    "quadratic-svm": (93, 99, 99),
    "nearest": (94, 99, 100),
    "boosted-trees": (69, 72, 73),
    "bagged-trees": (93, 100, 100),
    "subspace-discriminant": (91, 91, 91),
}
TESTED = {
    (16, 0.13, 0.015): 91.6, (16, 0.13, 0.010): 77.8, (16, 0.17, 0.015): 88.7, (16, 0.17, 0.010): 80.6,
    (8, 0.13, 0.015): 68.98, (8, 0.13, 0.010): 29.9, (8, 0.17, 0.015): 56.8, (8, 0.17, 0.010): 37.4,
}  # fmt: skip


class Fabric:
    """Observations of one fabric: `features` (T, C, P, M) of T repetitions of P presses of C classes; `tests` (C, P, M)
    and `shift` (M,), by how much the untouched fabric differs then; all without the noise of reading, whose
    deviation is `noise`, volts."""

    def __init__(self, electrodes: int, side: float, target: float, presses: int, nodes: int):
        outline = Rectangle(side, side)
        width = 0.4 * 4 * side / electrodes
        places = perimeter(outline, electrodes, start=side / (electrodes // 4) / 2)
        mesh = outline.mesh(num_points=nodes)
        model = ForwardModel(mesh, BoundaryElectrodes(places, width, 1e-2), opposite(electrodes, drives="all"))
        own = material("conductive fabric")
        skin = PressedSkin(jax.random.key(0), model, replace(own, noise=0.0))
        count = 7 if target > 0.012 else 10
        along = (np.arange(count) - (count - 1) / 2) * target
        self.middles = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
        # Medians of samples are noisier than means, by a quarter.
        self.noise = own.noise * float(np.sqrt(np.mean(skin.rest() ** 2))) * 1.25 / np.sqrt(SAMPLES)
        rng, rest = np.random.default_rng(0), skin.rest()

        def read(number: int, elapsed: float) -> np.ndarray:
            drawn = [_press(rng, middle, target) for middle in self.middles for _ in range(number)]
            frames = skin.frames(jax.random.key(int(elapsed)), [*drawn, ()], elapsed=elapsed) - rest
            self.shift = frames[-1]
            return frames[:-1].reshape(len(self.middles), number, -1)

        self.features = np.stack([read(presses, 60 * MINUTES * one) for one in range(REPETITIONS)])
        self.tests = read(TESTS, DAY)

    def observations(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """About `number` observations a class: features (N, M), class (N,) and repetition (N,)."""
        repetitions, classes, presses, channels = self.features.shape
        own = min(presses, max(1, number // repetitions))
        medians = max(1, number // (repetitions * own))
        exact = np.repeat(self.features[:, :, :own], medians, axis=2).reshape(-1, channels)
        noisy = exact + self.noise * np.random.default_rng(1).normal(size=exact.shape)
        label = np.tile(np.repeat(np.arange(classes), own * medians), repetitions)
        return noisy, label, np.repeat(np.arange(repetitions), classes * own * medians)

    def tested(self, model, scale, *, anew: bool = False) -> tuple[float, np.ndarray]:
        """Accuracy a day later, per cent, and how far (C,) squares told are from those touched on average, metres;
        with a reference taken `anew`."""
        noisy = self.tests - anew * self.shift + self.noise * np.random.default_rng(2).normal(size=self.tests.shape)
        said = log_odds(model, scale(noisy.reshape(-1, noisy.shape[-1]))).argmax(axis=1).reshape(len(self.middles), -1)
        right = np.arange(len(self.middles))[:, None]
        off = np.linalg.norm(self.middles[said] - self.middles[right], axis=-1)
        return 100 * float(np.mean(said == right)), off.mean(axis=1)


def run(options: Options) -> Result:
    """Nine classifiers by three sizes and two ways of holding out; eight fabrics; errors by distance and by size."""
    quick = options.quick
    presses, nodes, sizes = (2, 500, (12,)) if quick else (PRESSES, 2000, SIZES)
    fabric = Fabric(16, 0.13, 0.015, presses, nodes)
    names = ("linear-discriminant", "nearest") if quick else tuple(CLASSIFIERS)
    nine = [_nine(fabric, name, sizes) for name in names]
    header = [
        "classifier",
        *(f"{size} a class" for size in sizes),
        "a day later",
        "reference anew",
        "learnt in",
        "a frame",
    ]
    caption = (
        "Right of what was held out at random / by repetition (the paper's, at random); 13 cm, 15 mm, 16 electrodes."
    )
    told = [_cell(*key, presses, nodes, sizes[-1]) for key in list(TESTED)[: 1 if quick else None]]
    cells = [
        "electrodes",
        "side",
        "target",
        "a day later",
        "paper",
        "reference anew",
        "mean error",
        "by electrodes",
        "farthest",
    ]
    by_size = [_by_size(fabric, size) for size in sizes]
    tables = [
        Table(header, [row for row, *_ in nine], caption=caption),
        Table(cells, [row for row, _ in told]),
        Table(["observations a class", "a day later, reference anew", "mean error"], by_size),
    ]
    if quick:
        return Result(tables)
    day = {key: accuracy for key, (_, accuracy) in zip(TESTED, told, strict=True)}
    fewer = sum(day[16, side, target] > day[8, side, target] for number, side, target in TESTED if number == 16)
    larger = sum(
        day[number, side, 0.015] > day[number, side, 0.010] for number, side, target in TESTED if target == 0.015
    )
    gain = dict(zip(names, (first for _, first, _ in nine), strict=True))["quadratic-discriminant"]
    slowest = max(single for *_, single in nine)
    asked = [
        judged("16 electrodes tell more than 8, of four fabrics", f"{fewer}", fewer == 4),
        judged("larger targets are told better, of four fabrics", f"{larger}", larger == 4),
        judged(
            "the quadratic discriminant gains from more presses",
            f"{gain[0]:.0f} to {gain[-1]:.0f} %",
            gain[-1] > gain[0],
        ),
        judged("a frame is classified in < 1 ms by every classifier", duration(slowest), slowest < 1e-3),
    ]
    return Result(tables, asked)


def _nine(fabric: Fabric, name: str, sizes: tuple[int, ...]) -> tuple[list[str], list[float], float]:
    """A row of the paper's first table; per cent right of what was held out at random, by size; seconds of a frame."""
    cells, at_random = [], []
    for index, size in enumerate(sizes):
        if name in SLOW and size > 240:
            cells.append("–")
            continue
        features, label, repetition = fabric.observations(size)
        random = np.random.default_rng(0).permutation(len(label)) % REPETITIONS
        some = [_held_out(name, features, label, fold) for fold in (random, repetition)]
        at_random.append(some[0])
        paper = f" ({TRAINED[name][index]})" if len(sizes) == len(SIZES) else ""
        cells.append(f"{some[0]:.0f} / {some[1]:.0f} %{paper}")
    model, scale, spent = _fitted(name, *fabric.observations(sizes[min(1, len(sizes) - 1)])[:2])
    frame = scale(fabric.tests[0, :1])
    single = _median_seconds(lambda: log_odds(model, frame))
    days = [f"{fabric.tested(model, scale, anew=anew)[0]:.0f} %" for anew in (False, True)]
    row = [name, *cells, *days, duration(spent), duration(single)]
    say(" | ".join(row))
    return row, at_random, single


def _by_size(fabric: Fabric, size: int) -> list[str]:
    """How well the quadratic discriminant tells, a day later, from so many observations a class."""
    model, scale, _ = _fitted("quadratic-discriminant", *fabric.observations(size)[:2])
    accuracy, off = fabric.tested(model, scale, anew=True)
    return [str(size), f"{accuracy:.1f} %", f"{1e3 * off.mean():.1f} mm"]


def _press(rng, middle: np.ndarray, target: float) -> Press:
    """By a finger somewhat narrower than the target."""
    width = CONTACT * target
    pressure = np.exp(rng.uniform(*np.log(PRESSURE)))
    return Press(Disc(width), pressure * np.pi * width**2 / 4, middle + rng.uniform(-JITTER, JITTER, 2))


def _fitted(name: str, features, label):
    """A classifier of standardised features, what standardises, and the seconds it took."""
    mean, deviation = features.mean(axis=0), features.std(axis=0)
    start = time.perf_counter()
    model = CLASSIFIERS[name]((features - mean) / deviation, label)
    return model, lambda values: (values - mean) / deviation, time.perf_counter() - start


def _held_out(name: str, features, label, fold) -> float:
    """Per cent right of observations that were held out."""
    right = []
    for one in np.unique(fold):
        model, scale, _ = _fitted(name, features[fold != one], label[fold != one])
        said = log_odds(model, scale(features[fold == one])).argmax(axis=1)
        right.append(said == label[fold == one])
    return 100 * float(np.mean(np.concatenate(right)))


def _cell(electrodes, side, target, presses, nodes, size) -> tuple[list[str], float]:
    """A row of the paper's second table, and the accuracy a day later."""
    fabric = Fabric(electrodes, side, target, presses, nodes)
    model, scale, _ = _fitted("quadratic-discriminant", *fabric.observations(size)[:2])
    (as_it_is, _), (accuracy, off) = (fabric.tested(model, scale, anew=anew) for anew in (False, True))
    edge = side / 2 - np.abs(fabric.middles).max(axis=1)
    near, far = (1e3 * off[some].mean() for some in (edge == edge.min(), edge == edge.max()))
    paper = f"{TESTED[electrodes, side, target]:.1f} %"
    row = [str(electrodes), f"{100 * side:.0f} cm", f"{1e3 * target:.0f} mm", f"{as_it_is:.1f} %", paper]
    row += [f"{accuracy:.1f} %", f"{1e3 * off.mean():.1f} mm", f"{near:.1f} mm", f"{far:.1f} mm"]
    say(" | ".join(row))
    return row, accuracy


def _median_seconds(call, rounds: int = 30) -> float:
    spent = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        spent.append(time.perf_counter() - start)
    return float(np.median(spent))


CASE = Case("discriminants", "which square of a fabric is touched, by nine classifiers, beside the paper's", run, 8)
