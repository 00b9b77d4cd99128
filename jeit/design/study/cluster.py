"""Distribution of chunks of work over the workers of a cluster."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from jeit.arguments.extras import optional

_Result = TypeVar("_Result")


def over_cluster(
    client: Any, solve: Callable[[Any, int], _Result], work: Any, numbers: Iterable[int]
) -> Iterator[tuple[int, _Result]]:
    """Yield the numbers of chunks with the results of `solve(work, number)`, as the workers of a
    `dask.distributed.Client` complete them; chunks of a lost worker are solved again."""
    distributed = optional("distributed", "a cluster")
    # The work is sent once, as a task: where the only worker that has it is lost, it is sent again. Scattered, it would
    # be lost; with every chunk, a layer of 70 MB would go out a thousand times.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sending large graph")
        sent = client.submit(_same, work, pure=False)
    futures = {client.submit(solve, sent, number, pure=False, retries=2): number for number in numbers}
    try:
        for future, results in distributed.as_completed(futures, with_results=True):
            yield futures[future], results
            future.release()
    finally:
        client.cancel([sent, *futures])


def _same(work: Any) -> Any:
    return work
