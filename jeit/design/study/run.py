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
    """How far a study is: finished and all points and chunks; `seconds_left`, None until the first chunk of this run is
    finished."""

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
    - `progress`: called with a `Progress` at the start and after each chunk.

    Raises `ValueError` for electrodes too small for their mesh and for another study's store, before anything runs,
    `ImportError` without the extra `cluster`, and `OSError` where the store cannot be written, such as on a full disk:
    finished chunks are kept.
    """
    require("xarray")
    check_points(study)
    store = Store(study, path)
    done = set(store.sound())
    left = [number for number in range(len(study.chunks)) if number not in done]
    tell = _Teller(study, done, progress)
    for number, results in _solved(study, left, client):
        store.write(number, results)
        tell(number)
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
        self._tell(None)

    def __call__(self, number: int) -> None:
        self._done.add(number)
        pace = (time.monotonic() - self._start) / (self._points() - self._first)
        self._tell(pace * (len(self._study.points) - self._points()))

    def _points(self) -> int:
        return sum(len(self._study.chunks[number]) for number in self._done)

    def _tell(self, seconds_left: float | None) -> None:
        if self._progress is not None:
            all_points, all_chunks = len(self._study.points), len(self._study.chunks)
            self._progress(Progress(self._points(), all_points, len(self._done), all_chunks, seconds_left))


def _solved(study: Study, numbers: list[int], client: Any) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Chunks with their results, as they are solved."""
    if client is None:
        for number in numbers:
            yield number, solve_chunk(study, number)
        return
    distributed = require("distributed")
    [shared] = client.scatter([study], broadcast=True)
    futures = {client.submit(solve_chunk, shared, number, pure=False, retries=2): number for number in numbers}
    try:
        for future, results in distributed.as_completed(futures, with_results=True):
            yield futures[future], results
            future.release()
    finally:
        client.cancel(list(futures))
