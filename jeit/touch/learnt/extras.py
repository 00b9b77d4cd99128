"""What learning needs besides jeit's own dependencies, and how much of the machine it takes."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from importlib import import_module
from importlib.util import find_spec

import numpy as np

from jeit_solvers import number_of_cores


def need_learning() -> None:
    """Raise `ImportError`, saying what to install, where a package of the extra "learn" is missing."""
    missing = [name for name in ("sklearn", "skops", "optax") if find_spec(name) is None]
    if missing:
        raise ImportError(f"learnt skins need {' and '.join(missing)}; pip install 'jeit[learn]'.")


def one_thread() -> AbstractContextManager:
    """Within it libraries keep to one thread: on presses by the thousand, more wait for each other longer than they
    work."""
    from threadpoolctl import threadpool_limits

    import_module("sklearn.ensemble")  # only what is loaded is kept to it

    return threadpool_limits(1)


def over_threads(function: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, at_once: int) -> np.ndarray:
    """`function` of some rows at a time, side by side where there are many; what it gives, joined."""
    parts = [rows[first : first + at_once] for first in range(0, max(len(rows), 1), at_once)]
    if len(parts) < 4:
        return np.concatenate([function(part) for part in parts])
    with ThreadPoolExecutor(number_of_cores()) as pool:
        return np.concatenate(list(pool.map(function, parts)))
