"""Distribution of many equal parts of a computation over the cores of a machine.

XLA spreads a product of large matrices over all cores, but runs gathers, sums and small products of a compiled loop on
one core. Two loops in separate threads use two cores. NumPy likewise runs on one core, except for products, which its
BLAS spreads over all cores. While several threads work in NumPy, the BLAS is limited to one thread, because the threads
of BLAS would compete with these threads.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import importlib
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import threadpoolctl
from jaxtyping import Array, Int

# Maximum number of threads that work in NumPy at once: each thread needs its own memory, and all share the memory
# bandwidth.
_MAX_THREADS = 4
_thread_state = threading.local()


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
    parts_by_core = np.minimum(np.arange(num_cores * num_groups * group_size), num_parts - 1).reshape(
        num_cores, num_groups, group_size
    )
    with ThreadPoolExecutor(num_cores) as thread_pool:
        part_results = list(
            thread_pool.map(lambda part_index: jax.block_until_ready(function(part_index)), parts_by_core)
        )
    return part_results[0] if num_cores == 1 else jnp.concatenate(part_results)


def on_cores(function: Callable[[Any], Any], parts: Sequence[Any]) -> None:
    """Apply `function` to each part, in NumPy, in parallel on several cores; the function must store its results
    itself.

    Threads that are kept for this purpose process the parts, on as many cores as are free; the calling thread does if
    none is. A part may call `on_cores` itself: its own parts are shared as soon as another core has no work left. No
    part waits for a core, so parts may also wait for compiled programs that call NumPy from other threads. If a part
    raises an error, or the user interrupts, the other parts end at their next call of `check_not_abandoned`. Floating-
    point warnings are suppressed, because NaN is reported elsewhere.

    **Arguments:**

    - `function`: function of a part.
    - `parts`: arguments, one for each call of `function`.

    Raises the first error of a part.

    **Example:**

    ```python
    squares = np.zeros(4)
    on_cores(lambda part: squares.__setitem__(part, part**2), range(4))
    ```
    """
    call, is_nested_call = _CallOnCores(function, parts), getattr(_thread_state, "has_core", False)
    with one_thread_of_blas() if len(parts) > 1 else contextlib.nullcontext():
        if len(parts) <= 1 or is_nested_call or not call.take_core():
            call.process_parts()
        with call.free_cores.lend() if is_nested_call else contextlib.nullcontext():
            call.wait_until_done()
    if call.errors:
        raise call.errors[0]


class _CallOnCores:
    """A call of `on_cores`. Its state is in an object, because functions that refer to each other would keep the arrays
    of the parts in memory."""

    def __init__(self, function: Callable[[Any], Any], parts: Sequence[Any]):
        self.function, self.remaining_parts = function, collections.deque(parts)
        self.errors: list[BaseException] = []
        self.threads: list[Any] = []
        # A part is abandoned with the call that it belongs to, and with the calls around that.
        self.abandoned = threading.Event()
        self.abandoned_calls = (*getattr(_thread_state, "abandoned_calls", ()), self.abandoned)
        self.free_cores = _free_cores(os.getpid())

    def take_core(self) -> bool:
        """Start a thread that processes parts, if a core is free."""
        is_free = self.free_cores.acquire()
        if is_free:
            self.threads.append(_thread_pool(os.getpid()).submit(self._process_parts_on_core))
        return is_free

    def process_parts(self) -> None:
        """Process parts until none is left, and start further threads meanwhile."""
        outer_abandoned_calls, _thread_state.abandoned_calls = (
            getattr(_thread_state, "abandoned_calls", ()),
            self.abandoned_calls,
        )
        try:
            with np.errstate(all="ignore"):  # every thread has its own error state
                while self.remaining_parts and not self.abandoned.is_set():
                    if len(self.remaining_parts) > 1:
                        self.take_core()
                    try:
                        remaining_part = self.remaining_parts.popleft()
                    except IndexError:  # another thread has taken the last part
                        break
                    self.function(remaining_part)
        except BaseException as error:
            self.abandoned.set()
            self.errors.append(error)
        finally:
            _thread_state.abandoned_calls = outer_abandoned_calls

    def _process_parts_on_core(self) -> None:
        _thread_state.has_core = True
        try:
            self.process_parts()
        finally:
            self.free_cores.release()

    def wait_until_done(self) -> None:
        """Wait until all threads have ended, or one of them with an error."""
        try:
            while not self.errors and (
                running_threads := [helper_thread for helper_thread in self.threads if not helper_thread.done()]
            ):
                wait(running_threads, return_when=FIRST_COMPLETED)
        except BaseException:  # the user has interrupted
            self.abandoned.set()
            raise


def results_on_cores(function: Callable[[Any], Any], parts: Sequence[Any]) -> list[Any]:
    """Return the results of `function` for each part, computed in parallel by `on_cores`.

    **Arguments:**

    - `function`: function of a part.
    - `parts`: arguments, one for each call of `function`.

    **Example:**

    ```python
    results_on_cores(lambda part: part**2, range(4))
    ```
    """
    part_results: list[Any] = [None] * len(parts)

    def store_result(part_index: int) -> None:
        part_results[part_index] = function(parts[part_index])

    on_cores(store_result, range(len(parts)))
    return part_results


def check_not_abandoned() -> None:
    """End a part of `on_cores` by an error, if another part has raised an error or the user has interrupted. Parts that
    take more than a second call this function from time to time.

    Raises `RuntimeError` if the part is no longer needed.

    **Example:**

    ```python
    check_not_abandoned()
    ```
    """
    if any(abandoned_call.is_set() for abandoned_call in getattr(_thread_state, "abandoned_calls", ())):
        raise RuntimeError("abandoned, because another part of the computation has ended with an error.")


def parts_for_cores(number: int) -> list[slice]:
    """The indices 0 … `number` - 1 split into slices of about equal size, one for each core."""
    slice_boundaries = np.linspace(0, number, min(number_of_cores(), _MAX_THREADS, number) + 1).astype(int).tolist()
    return [slice(slice_start, slice_end) for slice_start, slice_end in itertools.pairwise(slice_boundaries)]


class _FreeCores:
    """The number of cores without work, and the number of threads that have not ended: at most one more than there are
    cores, as a thread that waits for others lends its core."""

    def __init__(self, number: int):
        self._num_free_cores, self._max_threads, self._num_threads = number, number + 1, 0
        self._lock = threading.Lock()

    def acquire(self) -> bool:
        """Take a core for a thread, if one is free."""
        with self._lock:
            if self._num_free_cores <= 0 or self._num_threads == self._max_threads:
                return False
            self._num_free_cores, self._num_threads = self._num_free_cores - 1, self._num_threads + 1
            return True

    def release(self) -> None:
        """Return the core of a thread that has ended."""
        with self._lock:
            self._num_free_cores, self._num_threads = self._num_free_cores + 1, self._num_threads - 1

    @contextlib.contextmanager
    def lend(self) -> Iterator[None]:
        """Lend the core of the calling thread while this thread waits. If another thread still uses the core then, both
        share it until one of them ends."""
        with self._lock:
            self._num_free_cores += 1
        try:
            yield
        finally:
            with self._lock:
                self._num_free_cores -= 1


@functools.cache
def _free_cores(process_id: int) -> _FreeCores:
    """The free cores of a process."""
    return _FreeCores(min(number_of_cores(), _MAX_THREADS))


@functools.cache
def _thread_pool(process_id: int) -> ThreadPoolExecutor:
    """Threads of a process that process parts (a forked process needs new ones). They are few and reused, because
    memory that new threads allocate and free, about a hundred megabytes, is not returned to the system."""
    return ThreadPoolExecutor(min(number_of_cores(), _MAX_THREADS) + 1, "jeit-core")


@functools.cache
def blas() -> threadpoolctl.ThreadpoolController:
    """Controller of the number of threads of the two BLAS libraries that NumPy and SciPy load."""
    importlib.import_module("scipy.linalg.cython_blas")  # loads SciPy's BLAS
    return threadpoolctl.ThreadpoolController().select(user_api="blas")


_active_blas_limits: list[Any] = []
_blas_limits_lock = threading.Lock()


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
    with _blas_limits_lock:
        if not _active_blas_limits:
            _take_control_of_blas()
        _active_blas_limits.append(None if _active_blas_limits else blas().limit(limits=1))
    try:
        yield
    finally:
        with _blas_limits_lock:
            thread_limit = _active_blas_limits.pop()
            if thread_limit is not None:  # the first context stores the original limits, and is removed last
                _take_control_of_blas()
                thread_limit.restore_original_limits()
                _take_control_of_blas()


def _take_control_of_blas() -> None:
    """Let any thread set the number of threads of BLAS next: from version 3.8 on, threadpoolctl obeys only the thread
    that set it first."""
    for blas_library in blas().lib_controllers:
        if isinstance(blas_library, threadpoolctl.OpenBLASController) and hasattr(
            blas_library, "clear_controlling_thread"
        ):
            blas_library.clear_controlling_thread(force=True)
