"""Run a study, chunk by chunk, here or on a cluster, so that it can be stopped at any moment."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jeit.design.study.batch import check_points, solve_chunk
from jeit.design.study.spec import Study
from jeit.design.study.store import Store, open_results, require


class Progress(NamedTuple):
    """How far a study is: finished and all points and chunks; `seconds_left`, None until the first of this run.

    With exact maps, `points` also counts those of a chunk that is not finished, and would be solved again.
    """

    points: int
    all_points: int
    chunks: int
    all_chunks: int
    seconds_left: float | None


def run_study(
    study: Study, path: str | Path, *, client: Any = None, progress: Callable[[Progress], None] | None = None
):
    """Run what is not finished of a study, and return its results, as of `open_results`.

    Killed at any moment, it goes on from the last finished chunk when run again, to the same store bit for bit.

    - `path`: of the Zarr store; made if there is none.
    - `client`: a `dask.distributed.Client`, whose workers have jeit installed; chunks of a worker that is lost are
      solved again, and only this process writes. In this process unless given.
    - `progress`: called with a `Progress` at the start and after each chunk; in this process, after each exact map too.

    Raises `ValueError` for meshes too coarse for their electrodes or touches, and for another study's store, before
    anything runs, `ImportError` without the extra `cluster`, and `OSError` where the store cannot be written, such as
    on a full disk: finished chunks are kept.
    """
    require("xarray")
    check_points(study)
    store = Store(study, path)
    done = set(store.sound())
    left = [number for number in range(len(study.chunks)) if number not in done]
    tell = _Teller(study, done, progress)
    for number, results in _solved(study, left, client, tell.solved):
        store.write(number, results)
        tell.finished(number)
    return open_results(study, path)


def study_progress(study: Study, path: str | Path) -> Progress:
    """How far the study in a store is; chunks that no longer read as written do not count. Raises as `Store` does."""
    finished = Store(study, path, create=False).sound()
    points = sum(len(study.chunks[number]) for number in finished)
    return Progress(points, len(study.points), len(finished), len(study.chunks), None)


class _Teller:
    """Calls `progress` and reckons the time left from the points finished since it was made."""

    def __init__(self, study: Study, done: set[int], progress: Callable[[Progress], None] | None):
        self._study, self._done, self._progress = study, set(done), progress
        self._first, self._start = self._points(), time.monotonic()
        self._tell(self._first, None)

    def finished(self, number: int) -> None:
        """A chunk is."""
        self._done.add(number)
        self._reckon(self._points())

    def solved(self, points: int) -> None:
        """So many points of the chunk under way are."""
        self._reckon(self._points() + points)

    def _reckon(self, points: int) -> None:
        pace = (time.monotonic() - self._start) / (points - self._first)
        self._tell(points, pace * (len(self._study.points) - points))

    def _points(self) -> int:
        return sum(len(self._study.chunks[number]) for number in self._done)

    def _tell(self, points: int, seconds_left: float | None) -> None:
        if self._progress is not None:
            all_points, all_chunks = len(self._study.points), len(self._study.chunks)
            self._progress(Progress(points, all_points, len(self._done), all_chunks, seconds_left))


def _solved(
    study: Study, numbers: list[int], client: Any, solved: Callable[[int], None]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Chunks with their results, as they are solved; `solved` as in `solve_chunk`."""
    if client is None:
        for number in numbers:
            yield number, solve_chunk(study, number, solved)
        return
    distributed = require("distributed")
    # The study goes with every chunk: scattered, it would be lost with a worker that alone has it.
    futures = {client.submit(solve_chunk, study, number, pure=False, retries=2): number for number in numbers}
    try:
        for future, results in distributed.as_completed(futures, with_results=True):
            yield futures[future], results
            future.release()
    finally:
        client.cancel(list(futures))
