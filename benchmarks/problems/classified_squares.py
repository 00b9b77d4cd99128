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
from jeit.touch.learnt.methods import CLASSIFIERS, log_odds
from jeit.touch.learnt.resource_limits import limit_to_one_thread

# Indices of the sixths of the observations that are held out, and maximum number of tested observations of a sixth.
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
        """Train the classifier called `name` on `features` (observations, channels) and the class of each observation,
        `label`."""
        mean, deviation = features.mean(axis=0), features.std(axis=0)
        start = time.perf_counter()
        with limit_to_one_thread():
            model = CLASSIFIERS[name]((features - mean) / deviation, label)
        return cls(model, mean, deviation, time.perf_counter() - start)

    def predict(self, features: Float[np.ndarray, "*n M"]) -> Int[np.ndarray, "*n"]:
        """The predicted class of each observation."""
        flat = (features.reshape(-1, features.shape[-1]) - self.mean) / self.deviation
        return log_odds(self.model, flat).argmax(axis=1).reshape(features.shape[:-1])


@dataclass(frozen=True)
class DayLater:
    """Results of tests a day later for C squares: `accuracy` in per cent, and `off` (C,) in millimetres.

    `off` is the mean distance of the predicted square from each touched square. The mean of `off` is the paper's
    average Euclidean error.
    """

    accuracy: float
    off: Float[np.ndarray, " C"]

    @classmethod
    def both(cls, learnt: Learnt, fabric: Fabric) -> tuple[DayLater, DayLater]:
        """Results for the squares of a fabric, with the old reference, and with a renewed reference."""
        return cls._of(learnt, fabric, anew=False), cls._of(learnt, fabric, anew=True)

    @classmethod
    def _of(cls, learnt: Learnt, fabric: Fabric, *, anew: bool) -> DayLater:
        predicted = learnt.predict(fabric.asked(anew=anew))
        right = np.arange(len(predicted))[:, None]
        off = np.linalg.norm(fabric.middles[predicted] - fabric.middles[right], axis=-1)
        return cls(100 * float(np.mean(predicted == right)), 1e3 * off.mean(axis=1))

    @property
    def cells(self) -> list[str]:
        """Texts of the accuracy, and of the mean error ± its standard deviation among the squares."""
        return [f"{self.accuracy:.1f} %", f"{self.off.mean():.1f} ± {self.off.std():.1f} mm"]


def held_out(name: str, features, label, repetition) -> tuple[float, float]:
    """Percentages of correctly classified observations in a held-out sixth, which is drawn at random, or is one of six
    repetitions.

    `features` (observations, channels) are the data. The sixths `HELD_OUT` are held out in turn; at most about `MOST`
    observations of each are tested.
    """
    random = np.random.default_rng(0).permutation(len(label)) % REPETITIONS

    def right(task: tuple[np.ndarray, int]) -> float:
        sixth, number = task
        held = sixth == number
        asked = np.flatnonzero(held)[:: max(1, np.count_nonzero(held) // MOST)]
        predicted = Learnt.by(name, features[~held], label[~held]).predict(features[asked])
        return 100 * float(np.mean(predicted == label[asked]))

    with limit_to_one_thread(), ThreadPoolExecutor(CORES) as pool:
        found = np.reshape(list(pool.map(right, product((random, repetition), HELD_OUT))), (2, -1)).mean(axis=1)
    return float(found[0]), float(found[1])


def seconds_of_a_frame(learnt: Learnt, fabric: Fabric, rounds: int = 30) -> float:
    """The median seconds for the classification of one frame."""
    frame, spent = fabric.asked(anew=False)[0, :1], []
    for _ in range(rounds):
        start = time.perf_counter()
        learnt.predict(frame)
        spent.append(time.perf_counter() - start)
    return float(np.median(spent))
