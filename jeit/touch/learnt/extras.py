"""How much of the machine learning takes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from importlib import import_module
from typing import Any

import numpy as np

from jeit_solvers import number_of_cores


def one_thread() -> AbstractContextManager:
    """Within it libraries keep to one thread: on presses by the thousand, more wait for each other longer than they
    work."""
    from threadpoolctl import threadpool_limits

    import_module("sklearn.ensemble")  # only what is loaded is kept to it

    return threadpool_limits(1)


def in_parts(function: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, at_once: int) -> np.ndarray:
    """`function` of some rows at a time, joined: what it makes on the way stays small."""
    return np.concatenate([function(rows[some]) for some in _parts(len(rows), at_once)])


def over_threads(
    function: Callable[..., dict[str, np.ndarray]], *arrays: np.ndarray, at_once: int
) -> dict[str, np.ndarray]:
    """`function` of some rows of `arrays` at a time, side by side where there are many; the arrays it gives, joined."""
    parts = _parts(len(arrays[0]), at_once)
    if len(parts) < 4:
        found = [function(*(one[some] for one in arrays)) for some in parts]
    else:
        with one_thread(), ThreadPoolExecutor(number_of_cores()) as pool:
            found = list(pool.map(lambda some: function(*(one[some] for one in arrays)), parts))
    return {key: np.concatenate([one[key] for one in found]) for key in found[0]}


def over_folds(function: Callable[[int], Any], number: int) -> list[Any]:
    """`function` of 0 … `number` - 1, side by side, each of them with one thread: OpenMP counts each thread's own."""

    def alone(fold: int) -> Any:
        with one_thread():
            return function(fold)

    with ThreadPoolExecutor(number_of_cores()) as pool:
        return list(pool.map(alone, range(number)))


def _parts(number: int, at_once: int) -> list[slice]:
    return [slice(first, first + at_once) for first in range(0, max(number, 1), at_once)]
