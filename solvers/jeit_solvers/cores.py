"""Distribution of many equal parts of a computation over the cores of a machine.

XLA spreads a product of large matrices over all cores, but runs gathers, sums and small products of a compiled loop on
one core. Two loops in separate threads use two cores. NumPy likewise runs on one core, except for products, which its
BLAS spreads over all cores. While several threads work in NumPy, the BLAS is limited to one thread, because the threads
of BLAS would compete with these threads.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
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

# Maximum number of threads that work in NumPy at once: each thread needs its own memory, and all share the memory
# bandwidth.
_MAX_THREADS = 4
# Prefix of the names of the threads of `on_cores`. A call from a thread with this prefix comes from inside a part.
_THREAD_NAME = "jeit-core"


def number_of_cores() -> int:
    """Number of cores that this process may use.

    **Example:**

    ```python
    number_of_cores()
    ```
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_of_machine() -> float:
    """Memory of the machine in bytes; 8 GB if the operating system does not state the memory."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return 8e9


def over_cores(function: Callable[[Int[np.ndarray, "c s"]], Array], num_parts: int, group_size: int) -> Array:
    """Compute a function for the parts 0 … `num_parts` - 1 of a computation on all cores, and concatenate the rows that
    the function returns. If the parts do not fill all groups, the rows of the last part are repeated at the end.

    The function is compiled once, because every core processes the same number c of groups. The results of a group must
    not depend on other groups; the results then do not depend on the number of cores.

    **Arguments:**

    - `function`: maps the indices (c, s) of c groups of s parts to an array (c s, …).
    - `num_parts`: number of parts.
    - `group_size`: number of parts s that are computed at a time.

    **Example:**

    ```python
    squares = over_cores(lambda indices: indices.ravel() ** 2, 10, 5)
    ```
    """
    num_groups = -(-num_parts // group_size)
    num_cores = min(number_of_cores(), num_groups)
    num_groups = -(-num_groups // num_cores)
    part_groups = np.minimum(np.arange(num_cores * num_groups * group_size), num_parts - 1).reshape(
        num_cores, num_groups, group_size
    )
    with ThreadPoolExecutor(num_cores) as pool:
        results = list(pool.map(lambda part: jax.block_until_ready(function(part)), part_groups))
    return results[0] if num_cores == 1 else jnp.concatenate(results)


def on_cores(function: Callable[[Any], Any], parts: Sequence[Any]) -> None:
    """Apply `function` to each part, in NumPy, in parallel on several cores; the function must store its results
    itself.

    The parts are processed in the calling thread if there is only one part, if the call comes from inside another part,
    or while another thread uses the cores. The reason is that parts may wait for compiled programs, which call NumPy
    from other threads. Floating-point warnings are suppressed, because NaN is reported elsewhere.

    **Arguments:**

    - `function`: function of a part.
    - `parts`: arguments, one for each call of `function`.

    **Example:**

    ```python
    squares = np.zeros(4)
    on_cores(lambda part: squares.__setitem__(part, part**2), range(4))
    ```
    """

    def apply_quietly(part: Any) -> None:
        with np.errstate(all="ignore"):  # every thread has its own error state
            function(part)

    is_nested = threading.current_thread().name.startswith(_THREAD_NAME)
    if len(parts) <= 1 or is_nested or not _pool_lock(os.getpid()).acquire(blocking=False):
        for part in parts:
            apply_quietly(part)
        return
    try:
        with one_thread_of_blas():
            list(_thread_pool(os.getpid()).map(apply_quietly, parts))
    finally:
        _pool_lock(os.getpid()).release()


def parts_for_cores(number: int) -> list[slice]:
    """The indices 0 … `number` - 1 split into slices of about equal size, one for each core."""
    ends = np.linspace(0, number, min(number_of_cores(), _MAX_THREADS, number) + 1).astype(int).tolist()
    return [slice(start, stop) for start, stop in itertools.pairwise(ends)]


@functools.cache
def _thread_pool(process: int) -> ThreadPoolExecutor:
    """Thread pool of a process (a forked process needs a new pool). The pool is reused, because memory that new threads
    allocate and free, about a hundred megabytes, is not returned to the system."""
    return ThreadPoolExecutor(min(number_of_cores(), _MAX_THREADS), _THREAD_NAME)


@functools.cache
def _pool_lock(process: int) -> threading.Lock:
    """Lock of the thread pool of a process."""
    return threading.Lock()


@functools.cache
def blas() -> threadpoolctl.ThreadpoolController:
    """Controller of the number of threads of the two BLAS libraries that NumPy and SciPy load."""
    importlib.import_module("scipy.linalg.cython_blas")  # loads SciPy's BLAS
    return threadpoolctl.ThreadpoolController().select(user_api="blas")


_active_limits: list[Any] = []
_limits_lock = threading.Lock()


@contextlib.contextmanager
def one_thread_of_blas() -> Iterator[None]:
    """Limit the BLAS to one thread while this context, or another context of this kind, is active. Entering takes a few
    microseconds.

    **Example:**

    ```python
    with one_thread_of_blas():
        np.linalg.inv(chain)
    ```
    """
    with _limits_lock:
        if not _active_limits:
            _take_control()
        _active_limits.append(None if _active_limits else blas().limit(limits=1))
    try:
        yield
    finally:
        with _limits_lock:
            limit = _active_limits.pop()
            if limit is not None:  # the first context stores the original limits, and is removed last
                _take_control()
                limit.restore_original_limits()
                _take_control()


def _take_control() -> None:
    """Let any thread set the number of threads of BLAS next: from version 3.8 on, threadpoolctl obeys only the thread
    that set it first."""
    for library in blas().lib_controllers:
        if isinstance(library, threadpoolctl.OpenBLASController) and hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)
