"""Running of a study of electrode layouts, on this machine or on a cluster, with reports of the progress."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from jeit.arguments.extras import import_optional, require_extra
from jeit.design.study.batch import check_points, solve_chunk
from jeit.design.study.spec import Study
from jeit.design.study.store import Store, open_results, writing


class Progress(NamedTuple):
    """Progress of the computation of a study.

    **Fields**: `points`, `all_points`: finished and total number of points; `chunks`, `all_chunks`: finished and total
    number of chunks; `seconds_left`: estimated remaining time, None until this run has finished its first point.

    With exact sensitivity maps, `points` includes points of the current chunk, which would be solved again after an
    interruption.
    """

    points: int
    all_points: int
    chunks: int
    all_chunks: int
    seconds_left: float | None


class ProgressReporter:
    """Reports the progress of work in `chunks` by calling `progress`, and estimates the remaining time from the points
    finished since the reporter's creation. `finished_chunks`: numbers of the chunks that were finished before."""

    def __init__(
        self, chunks: Sequence[Sequence[int]], finished_chunks: set[int], progress: Callable[[Progress], None] | None
    ):
        self._points_of_chunks, self._finished_chunks, self._progress_callback = chunks, set(finished_chunks), progress
        self._num_points = sum(len(chunk_points) for chunk_points in chunks)
        self._initial_points, self._start_time = self._num_finished_points(), time.monotonic()
        self._report_progress(self._initial_points, None)

    def report_finished_chunk(self, number: int) -> None:
        """Report that the chunk `number` is finished."""
        self._finished_chunks.add(number)
        self._estimate_and_report(self._num_finished_points())

    def report_points(self, points: int) -> None:
        """Report the number of finished points of the current chunk."""
        self._estimate_and_report(self._num_finished_points() + points)

    def _estimate_and_report(self, num_finished_points: int) -> None:
        seconds_per_point = (time.monotonic() - self._start_time) / (num_finished_points - self._initial_points)
        self._report_progress(num_finished_points, seconds_per_point * (self._num_points - num_finished_points))

    def _num_finished_points(self) -> int:
        return sum(len(self._points_of_chunks[chunk_number]) for chunk_number in self._finished_chunks)

    def _report_progress(self, num_finished_points: int, seconds_left: float | None) -> None:
        if self._progress_callback is not None:
            self._progress_callback(
                Progress(
                    num_finished_points,
                    self._num_points,
                    len(self._finished_chunks),
                    len(self._points_of_chunks),
                    seconds_left,
                )
            )


_Result = TypeVar("_Result")


def solve_on_cluster(
    client: Any, solve: Callable[[Any, int], _Result], shared_data: Any, numbers: Iterable[int]
) -> Iterator[tuple[int, _Result]]:
    """Yield the number of each chunk with its results `solve(shared_data, number)`, in the order in which the workers
    of a `dask.distributed.Client` complete the chunks. Chunks of a lost worker are solved again."""
    distributed = import_optional("distributed", "a cluster")
    # `shared_data` is sent once, as a task, so that it is sent again if the only worker that has it is lost.
    # Scattered data would then be lost, and sending `shared_data` with every chunk would transfer a layer of 70 MB a
    # thousand times.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sending large graph")
        shared_data_future = client.submit(_return_unchanged, shared_data, pure=False)
    chunk_futures = {
        client.submit(solve, shared_data_future, chunk_number, pure=False, retries=2): chunk_number
        for chunk_number in numbers
    }
    try:
        for chunk_future, chunk_results in distributed.as_completed(chunk_futures, with_results=True):
            yield chunk_futures[chunk_future], chunk_results
            chunk_future.release()
    finally:
        client.cancel([shared_data_future, *chunk_futures])


def _return_unchanged(unchanged_data: Any) -> Any:
    return unchanged_data


def run_study(
    study: Study, path: str | Path, *, client: Any = None, progress: Callable[[Progress], None] | None = None
):
    """Compute the unfinished chunks of a study, and return the results as `open_results` does.

    If a run is killed at any moment, the next run continues after the last finished chunk and gives the same store of
    results bit for bit.

    **Arguments:**

    - `study`: the study.
    - `path`: path of the Zarr store, which is created if it does not exist.
    - `client`: a `dask.distributed.Client` whose workers have jeit installed. Chunks of a lost worker are solved again,
      and only this process writes the store. By default, the chunks are computed in this process.
    - `progress`: function called with a `Progress` at the start and after each chunk; without a `client`, also after
      each exact map.

    Only one process at a time may run a study; locks of processes that have ended are ignored. Raises `ValueError`,
    before any chunk is computed, for meshes too coarse for their electrodes or touches, for the store of a different
    study, and for a store that another process writes. Raises `ImportError` without the extra `cluster`, and `OSError`
    if the store cannot be written, such as on a full disk; finished chunks are kept.

    **Example:**

    ```python
    results = run_study(study, "study.zarr", progress=print)  # with zarr
    print(results["mean"].values)
    ```
    """
    require_extra("cluster", "a study")
    check_points(study)
    with writing(study, path) as results_store:
        finished_chunks = set(results_store.intact_chunks())
        remaining_chunks = [
            chunk_number for chunk_number in range(len(study.chunks)) if chunk_number not in finished_chunks
        ]
        progress_reporter = ProgressReporter(study.chunks, finished_chunks, progress)
        for chunk_number, chunk_results in _solve_chunks(
            study, remaining_chunks, client, progress_reporter.report_points
        ):
            results_store.write(chunk_number, chunk_results)
            progress_reporter.report_finished_chunk(chunk_number)
    return open_results(study, path)


def study_progress(study: Study, path: str | Path) -> Progress:
    """Count the finished points and chunks of a study in a store of results. Chunks that do not match their checksums
    count as unfinished.

    **Arguments:**

    - `study`: the study.
    - `path`: path of the Zarr store.

    Raises the errors of `Store`.

    **Example:**

    ```python
    run_study(study, "study.zarr")  # with zarr
    print(study_progress(study, "study.zarr"))
    ```
    """
    finished_chunks = Store(study, path, create=False).intact_chunks()
    num_finished_points = sum(len(study.chunks[chunk_number]) for chunk_number in finished_chunks)
    return Progress(num_finished_points, len(study.points), len(finished_chunks), len(study.chunks), None)


def _solve_chunks(
    study: Study, chunk_numbers: list[int], cluster_client: Any, report_num_solved: Callable[[int], None]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Yield the number of each chunk of a study with its results, in the order in which the chunks are solved;
    `report_num_solved` as in `solve_chunk`."""
    if cluster_client is None:
        for chunk_number in chunk_numbers:
            yield chunk_number, solve_chunk(study, chunk_number, report_num_solved)
        return
    yield from solve_on_cluster(cluster_client, solve_chunk, study, chunk_numbers)
