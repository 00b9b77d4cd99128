"""Long work of many equal parts, shared between the cores of a machine.

XLA spreads one product of large matrices over all cores, but runs gathers, sums and small products of a compiled loop
on one; two loops side by side, each on a thread of its own, keep two cores busy.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int


def number_of_cores() -> int:
    """Of those that this process may use."""
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
