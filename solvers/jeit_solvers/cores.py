"""Parallel work of many equal parts, shared between the cores of a machine.

XLA spreads one product of large matrices over all cores, but runs gathers, sums and small products of a compiled loop
on one; two loops side by side, each on a thread of its own, keep two cores busy. So does NumPy, whose products alone
are spread by its BLAS: threads of ours and of the BLAS's own would wait for each other, and it is kept to one.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import threadpoolctl
from jaxtyping import Array, Int

# Threads at most, that work in NumPy side by side: each takes memory of its own, and they share the memory's bandwidth.
_MOST_THREADS = 4
# Prefix of the names of our threads.
_NAME = "jeit-core"


def number_of_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def over_cores(function: Callable[[Int[np.ndarray, "c s"]], Array], number: int, size: int) -> Array:
    """Rows of `function` for the parts 0 … `number` - 1, `size` of them at a time, joined; the last may be repeated.

    `function`: from numbers of parts (c, s), s at a time, to an array (c s, …); compiled for one c. What it does with
    a group of s parts must not depend on the others, then the result does not depend on the number of cores.
    """
    groups = -(-number // size)
    cores = min(number_of_cores(), groups)
    groups = -(-groups // cores)
    parts = np.minimum(np.arange(cores * groups * size), number - 1).reshape(cores, groups, size)
    with ThreadPoolExecutor(cores) as pool:
        results = list(pool.map(lambda part: jax.block_until_ready(function(part)), parts))
    return results[0] if cores == 1 else jnp.concatenate(results)


def on_cores(function: Callable[[Any], Any], parts: Sequence[Any]) -> None:
    """`function` of each of some parts, in NumPy, side by side on every core; it puts what it makes in place.

    One part, and what is asked for by a part of other work, is done at once. NaN is reported elsewhere: nothing warns.
    """

    def quietly(part: Any) -> None:
        with np.errstate(all="ignore"):  # threads have error states of their own
            function(part)

    if len(parts) <= 1 or threading.current_thread().name.startswith(_NAME):
        for part in parts:
            quietly(part)
        return
    with _one_thread_of_blas():
        list(_workers(os.getpid()).map(quietly, parts))


def parts_for_cores(number: int) -> list[slice]:
    """0 … `number` - 1 in parts of about equal size, one for each core."""
    ends = np.linspace(0, number, min(number_of_cores(), _MOST_THREADS, number) + 1).astype(int).tolist()
    return [slice(*both) for both in itertools.pairwise(ends)]


@functools.cache
def _workers(process: int) -> ThreadPoolExecutor:
    """Threads of a process, which a fork of it has not. They are kept: what new ones allocate and free stays with the
    process, a hundred megabytes every time."""
    return ThreadPoolExecutor(min(number_of_cores(), _MOST_THREADS), _NAME)


@functools.cache
def blas() -> threadpoolctl.ThreadpoolController:
    """NumPy's BLAS, and others that were loaded when it was first asked for; what comes later is not NumPy's."""
    return threadpoolctl.ThreadpoolController().select(user_api="blas")


_kept: list[Any] = []
_keeping = threading.Lock()


@contextlib.contextmanager
def _one_thread_of_blas() -> Iterator[None]:
    """Within it, and for as long as anyone else is, the BLAS keeps to one thread; a few microseconds."""
    with _keeping:
        _kept.append(None if _kept else blas().limit(limits=1))
    try:
        yield
    finally:
        with _keeping:
            limit = _kept.pop()
            if limit is not None:  # the first, who knows how many threads there were, is the last in the list to go
                limit.restore_original_limits()
