"""Classification of the squares of a fabric by one of nine classifiers, for held-out presses and for presses a day
later.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from benchmarks.harness.machine import CORES
from benchmarks.problems.fabric import REPETITIONS, Fabric
from jeit.touch.learnt.extras import one_thread
from jeit.touch.learnt.methods import CLASSIFIERS, log_odds

# Of six sixths, and of the observations in one.
HELD_OUT, MOST = (2, 5), 2000


@dataclass(frozen=True)
class Learnt:
    """A classifier of standardised features, and the `seconds` of its training."""

    model: Any
    mean: Float[np.ndarray, " M"]
    deviation: Float[np.ndarray, " M"]
    seconds: float

    @classmethod
    def by(cls, name: str, features: Float[np.ndarray, "N M"], label: Int[np.ndarray, " N"]) -> Learnt:
        """The method of this name, trained on observations and their classes."""
        mean, deviation = features.mean(axis=0), features.std(axis=0)
        start = time.perf_counter()
        with one_thread():
            model = CLASSIFIERS[name]((features - mean) / deviation, label)
        return cls(model, mean, deviation, time.perf_counter() - start)

    def predict(self, features: Float[np.ndarray, "*n M"]) -> Int[np.ndarray, "*n"]:
        """The predicted class of each."""
        flat = (features.reshape(-1, features.shape[-1]) - self.mean) / self.deviation
        return log_odds(self.model, flat).argmax(axis=1).reshape(features.shape[:-1])


@dataclass(frozen=True)
class DayLater:
    """Results of tests a day later: `accuracy`, per cent, and `off` (C,), mm.

    `off` is the mean distance of the predicted square from each touched one. Its mean is the paper's average Euclidean
    error.
    """

    accuracy: float
    off: Float[np.ndarray, " C"]

    @classmethod
    def both(cls, learnt: Learnt, fabric: Fabric) -> tuple[DayLater, DayLater]:
        """Results for a fabric's squares, as they are read, and with a renewed reference."""
        return cls._of(learnt, fabric, anew=False), cls._of(learnt, fabric, anew=True)

    @classmethod
    def _of(cls, learnt: Learnt, fabric: Fabric, *, anew: bool) -> DayLater:
        predicted = learnt.predict(fabric.asked(anew=anew))
        right = np.arange(len(predicted))[:, None]
        off = np.linalg.norm(fabric.middles[predicted] - fabric.middles[right], axis=-1)
        return cls(100 * float(np.mean(predicted == right)), 1e3 * off.mean(axis=1))

    @property
    def cells(self) -> list[str]:
        """Accuracy, error, and its deviation among the squares."""
        return [f"{self.accuracy:.1f} %", f"{self.off.mean():.1f} ± {self.off.std():.1f} mm"]


def held_out(name: str, features, label, repetition) -> tuple[float, float]:
    """Per cent right of observations (N, M), of which one sixth was held out: at random, and one repetition of six.

    The sixths `HELD_OUT` in turn. Of each at most about `MOST` are tested.
    """
    random = np.random.default_rng(0).permutation(len(label)) % REPETITIONS

    def right(task: tuple[np.ndarray, int]) -> float:
        sixth, number = task
        held = sixth == number
        asked = np.flatnonzero(held)[:: max(1, np.count_nonzero(held) // MOST)]
        predicted = Learnt.by(name, features[~held], label[~held]).predict(features[asked])
        return 100 * float(np.mean(predicted == label[asked]))

    with one_thread(), ThreadPoolExecutor(CORES) as pool:
        found = np.reshape(list(pool.map(right, product((random, repetition), HELD_OUT))), (2, -1)).mean(axis=1)
    return float(found[0]), float(found[1])


def seconds_of_a_frame(learnt: Learnt, fabric: Fabric, rounds: int = 30) -> float:
    """The median time of one frame."""
    frame, spent = fabric.asked(anew=False)[0, :1], []
    for _ in range(rounds):
        start = time.perf_counter()
        learnt.predict(frame)
        spent.append(time.perf_counter() - start)
    return float(np.median(spent))
