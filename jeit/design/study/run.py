"""Run a study: batches on this machine or on a cluster, with progress."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from jeit.arguments.extras import need_extra, optional
from jeit.design.study.batch import check_points, solve_chunk
from jeit.design.study.spec import Study
from jeit.design.study.store import Store, open_results, writing


class Progress(NamedTuple):
    """Progress of a study: finished and total points and chunks; `seconds_left`, None until the first point of this
    run.

    With exact maps, `points` also counts those of a chunk that is not finished, and would be solved again.
    """

    points: int
    all_points: int
    chunks: int
    all_chunks: int
    seconds_left: float | None


class ProgressReporter:
    """Calls `progress` for work in `chunks`, and estimates the remaining time from the points finished since its
    creation; `done` were finished before."""

    def __init__(self, chunks: Sequence[Sequence[int]], done: set[int], progress: Callable[[Progress], None] | None):
        self._chunks, self._done, self._progress = chunks, set(done), progress
        self._all = sum(len(chunk) for chunk in chunks)
        self._first, self._start = self._points(), time.monotonic()
        self._report(self._first, None)

    def finished(self, number: int) -> None:
        """Report a finished chunk."""
        self._done.add(number)
        self._reckon(self._points())

    def solved(self, points: int) -> None:
        """Report the number of finished points of the current chunk."""
        self._reckon(self._points() + points)

    def _reckon(self, points: int) -> None:
        pace = (time.monotonic() - self._start) / (points - self._first)
        self._report(points, pace * (self._all - points))

    def _points(self) -> int:
        return sum(len(self._chunks[number]) for number in self._done)

    def _report(self, points: int, seconds_left: float | None) -> None:
        if self._progress is not None:
            self._progress(Progress(points, self._all, len(self._done), len(self._chunks), seconds_left))


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


def run_study(
    study: Study, path: str | Path, *, client: Any = None, progress: Callable[[Progress], None] | None = None
):
    """Run the unfinished chunks of a study, and return its results, as of `open_results`.

    If killed at any moment, the next run continues after the last finished chunk and gives the same store bit for bit.

    - `path`: path of the Zarr store; created if there is none.
    - `client`: a `dask.distributed.Client`, whose workers have jeit installed; chunks of a worker that is lost are
      solved again, and only this process writes. In this process unless given.
    - `progress`: called with a `Progress` at the start and after each chunk; in this process, after each exact map too.

    Only one process at a time may run a study; locks of ended processes are ignored. Raises `ValueError` for meshes too
    coarse for their electrodes or touches, for another study's store, and for one that another process writes, before
    anything runs, `ImportError` without the extra `cluster`, and `OSError` where the store cannot be written, such as
    on a full disk: finished chunks are kept.
    """
    need_extra("cluster", "a study")
    check_points(study)
    with writing(study, path) as store:
        done = set(store.sound())
        left = [number for number in range(len(study.chunks)) if number not in done]
        report = ProgressReporter(study.chunks, done, progress)
        for number, results in _solved(study, left, client, report.solved):
            store.write(number, results)
            report.finished(number)
    return open_results(study, path)


def study_progress(study: Study, path: str | Path) -> Progress:
    """Progress of the study in a store; chunks that no longer match their checksums do not count. Raises as `Store`
    does."""
    finished = Store(study, path, create=False).sound()
    points = sum(len(study.chunks[number]) for number in finished)
    return Progress(points, len(study.points), len(finished), len(study.chunks), None)


def _solved(
    study: Study, numbers: list[int], client: Any, solved: Callable[[int], None]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Yield chunks with their results, as they are solved; `solved` as in `solve_chunk`."""
    if client is None:
        for number in numbers:
            yield number, solve_chunk(study, number, solved)
        return
    yield from over_cluster(client, solve_chunk, study, numbers)
