"""Limit the number of threads and the memory that machine learning uses."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from importlib import import_module
from typing import Any

import numpy as np

from jeit_solvers import number_of_cores


def limit_to_one_thread() -> AbstractContextManager:
    """Return a context manager within which numerical libraries use one thread.

    In learning from thousands of presses, several threads spend more time waiting for each other than computing.
    """
    from threadpoolctl import threadpool_limits

    import_module("sklearn.ensemble")  # the limit applies only to libraries that are already loaded

    return threadpool_limits(1)


def apply_in_parts(function: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, chunk_size: int) -> np.ndarray:
    """Apply `function` to `chunk_size` rows of an array at a time, which limits memory, and concatenate the results."""
    return np.concatenate([function(rows[chunk_slice]) for chunk_slice in _chunk_slices(len(rows), chunk_size)])


def apply_over_threads(
    function: Callable[..., dict[str, np.ndarray]], *arrays: np.ndarray, chunk_size: int
) -> dict[str, np.ndarray]:
    """Apply `function` to `chunk_size` rows of the `arrays` at a time, and concatenate the arrays that `function`
    returns.

    If there are many parts of `chunk_size` rows, they are computed in parallel.
    """
    chunk_slices = _chunk_slices(len(arrays[0]), chunk_size)
    if len(chunk_slices) < 4:
        chunk_results = [function(*(array[chunk_slice] for array in arrays)) for chunk_slice in chunk_slices]
    else:
        with limit_to_one_thread(), ThreadPoolExecutor(number_of_cores()) as thread_pool:
            chunk_results = list(
                thread_pool.map(lambda chunk_slice: function(*(array[chunk_slice] for array in arrays)), chunk_slices)
            )
    return {
        array_name: np.concatenate([chunk_result[array_name] for chunk_result in chunk_results])
        for array_name in chunk_results[0]
    }


def apply_over_folds(function: Callable[[int], Any], num_folds: int) -> list[Any]:
    """Apply `function` to the index of each cross-validation fold, 0 … `num_folds` - 1, in parallel, with one thread
    for each call.

    The limit of one thread is set in every call, since OpenMP keeps a separate number of threads for each calling
    thread.
    """

    def apply_with_one_thread(fold_index: int) -> Any:
        with limit_to_one_thread():
            return function(fold_index)

    with ThreadPoolExecutor(number_of_cores()) as thread_pool:
        return list(thread_pool.map(apply_with_one_thread, range(num_folds)))


def _chunk_slices(num_rows: int, chunk_size: int) -> list[slice]:
    return [slice(chunk_start, chunk_start + chunk_size) for chunk_start in range(0, max(num_rows, 1), chunk_size)]
