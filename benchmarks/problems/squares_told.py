"""What is told of the squares of a fabric: learnt by one of nine classifiers, of presses held out and a day later."""

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

# Of six sixths; and of the observations in one.
HELD_OUT, MOST = (2, 5), 2000


@dataclass(frozen=True)
class Learnt:
    """A classifier of standardised features, and the `seconds` that learning took."""

    model: Any
    mean: Float[np.ndarray, " M"]
    deviation: Float[np.ndarray, " M"]
    seconds: float

    @classmethod
    def by(cls, name: str, features: Float[np.ndarray, "N M"], label: Int[np.ndarray, " N"]) -> Learnt:
        """The method of this name, from observations and their classes."""
        mean, deviation = features.mean(axis=0), features.std(axis=0)
        start = time.perf_counter()
        with one_thread():
            model = CLASSIFIERS[name]((features - mean) / deviation, label)
        return cls(model, mean, deviation, time.perf_counter() - start)

    def tell(self, features: Float[np.ndarray, "*n M"]) -> Int[np.ndarray, "*n"]:
        """The class of each."""
        flat = (features.reshape(-1, features.shape[-1]) - self.mean) / self.deviation
        return log_odds(self.model, flat).argmax(axis=1).reshape(features.shape[:-1])


@dataclass(frozen=True)
class Told:
    """Of tests a day later: `accuracy`, per cent, and how far the square told is from each touched, on average, `off`
    (C,), mm; its mean is the paper's average Euclidean error."""

    accuracy: float
    off: Float[np.ndarray, " C"]

    @classmethod
    def both(cls, learnt: Learnt, fabric: Fabric) -> tuple[Told, Told]:
        """What is told of a fabric's squares, as they are read, and with a reference taken anew."""
        return cls._of(learnt, fabric, anew=False), cls._of(learnt, fabric, anew=True)

    @classmethod
    def _of(cls, learnt: Learnt, fabric: Fabric, *, anew: bool) -> Told:
        said = learnt.tell(fabric.asked(anew=anew))
        right = np.arange(len(said))[:, None]
        off = np.linalg.norm(fabric.middles[said] - fabric.middles[right], axis=-1)
        return cls(100 * float(np.mean(said == right)), 1e3 * off.mean(axis=1))

    @property
    def cells(self) -> list[str]:
        """Accuracy; error, and its deviation among the squares."""
        return [f"{self.accuracy:.1f} %", f"{self.off.mean():.1f} ± {self.off.std():.1f} mm"]


def held_out(name: str, features, label, repetition) -> tuple[float, float]:
    """Per cent right of observations (N, M), of which one sixth was held out: at random, and one repetition of six.

    The sixths `HELD_OUT` in turn; of each at most about `MOST` are asked.
    """
    random = np.random.default_rng(0).permutation(len(label)) % REPETITIONS

    def right(task: tuple[np.ndarray, int]) -> float:
        sixth, number = task
        held = sixth == number
        asked = np.flatnonzero(held)[:: max(1, np.count_nonzero(held) // MOST)]
        said = Learnt.by(name, features[~held], label[~held]).tell(features[asked])
        return 100 * float(np.mean(said == label[asked]))

    with one_thread(), ThreadPoolExecutor(CORES) as pool:
        found = np.reshape(list(pool.map(right, product((random, repetition), HELD_OUT))), (2, -1)).mean(axis=1)
    return float(found[0]), float(found[1])


def seconds_of_a_frame(learnt: Learnt, fabric: Fabric, rounds: int = 30) -> float:
    """The median that one takes."""
    frame, spent = fabric.asked(anew=False)[0, :1], []
    for _ in range(rounds):
        start = time.perf_counter()
        learnt.tell(frame)
        spent.append(time.perf_counter() - start)
    return float(np.median(spent))
