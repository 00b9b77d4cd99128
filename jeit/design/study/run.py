"""Run a study, chunk by chunk, here or on a cluster, so that it can be stopped at any moment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jeit.arguments.extras import need_extra
from jeit.design.study.batch import check_points, solve_chunk
from jeit.design.study.cluster import over_cluster
from jeit.design.study.progress import Progress, ProgressReporter
from jeit.design.study.spec import Study
from jeit.design.study.store import Store, open_results, writing


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
