"""Times of functions within one process: the time of the first call, and the median time of later calls."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple


class Timed(NamedTuple):
    """Median seconds of a call, the additional time of the first call (compilation), and the last call's result."""

    median: float
    compile: float
    answer: Any


def timed(function: Callable[[], Any], rounds: int, budget: float = float("inf")) -> Timed:
    """Time a function: call it once, then `rounds` times, or fewer times (at least once) if these calls take more than
    `budget` seconds.

    The function waits for the results of JAX.
    """
    import jax

    spent: list[float] = []
    answer = None
    for _ in range(rounds + 1):
        start = time.perf_counter()
        answer = jax.block_until_ready(function())
        spent.append(time.perf_counter() - start)
        if len(spent) > 1 and sum(spent[1:]) > budget:
            break
    middle = statistics.median(spent[1:])
    return Timed(middle, max(spent[0] - middle, 0.0), answer)


def least_times(functions: dict[str, Callable[[], Any]], repeats: int = 15, budget: float = 4.0) -> dict[str, float]:
    """Least time in seconds of each function, with interleaved repeats, as many as fit in `budget` seconds.

    Least times serve to choose the fastest of several alternatives, and are not reported as figures.
    """
    least, start = dict.fromkeys(functions, float("inf")), time.perf_counter()
    for _ in range(repeats):
        for name, function in functions.items():
            begin = time.perf_counter()
            function()
            least[name] = min(least[name], time.perf_counter() - begin)
        if time.perf_counter() - start > budget:
            break
    return least


def say(text: str) -> None:
    """Print progress to standard error, separate from the report."""
    print(text, file=sys.stderr, flush=True)
