"""Studies against kill -9, full disks, damaged files and lost workers: nothing is lost, and nothing is solved twice."""

import errno
import os
import re
import shutil
import signal

import numpy as np
import pytest
from studies import ARRAYS, contents, in_another_process

from jeit.design.study import open_results, run_study, study_progress
from jeit.design.study import store as store_module
from jeit.design.study.store import Store

pytest.importorskip("xarray")
pytest.importorskip("zarr")


# The files that Zarr has written when the second chunk's sensitivities exist and its last arrays do not.
FILES = 12 + 2 * ARRAYS + 7  # 12 of coordinates, and those of the first chunk
KILLED_BY_ZARR = """
import os, signal, sys
from pathlib import Path
from jeit.design.study import open_results, read_study, run, run_study

study = read_study(sys.argv[1])
data = open_results(study, sys.argv[3])  # no need to solve again what is known

def known(study, number, *rest):
    points = list(study.chunks[number])
    return {{name: data[name].values[points] for name in data.data_vars}}

run.solve_chunk = known
replace, calls = Path.replace, []

def dying(self, target):
    calls.append(self.suffix == ".partial" and "/c/" in str(self))
    if sum(calls) == {calls}:
        os.kill(os.getpid(), signal.SIGKILL)
    return replace(self, target)

Path.replace = dying
run_study(study, sys.argv[2])
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
@pytest.mark.slow
def test_after_a_kill_inside_a_chunk_the_resumed_store_is_the_same(
    study, study_file, whole_store, store_path, watch_chunks
):
    """Half of the second chunk's last array, and part of the next file, which Zarr was writing under another name."""
    ended = in_another_process(KILLED_BY_ZARR.format(calls=FILES), study_file, store_path, whole_store)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert study_progress(study, store_path).chunks == 1
    torn = contents(store_path)
    assert len([name for name in torn if name.startswith("sensitivity/c/")]) > 2
    assert [name for name in torn if name.endswith(".partial")]
    data = open_results(study, store_path)
    assert data.finished.values.sum() == 2
    assert np.isnan(data.sensitivity.values[~data.finished.values]).all()  # an incomplete array is not read
    solved = watch_chunks()
    run_study(study, store_path)
    assert solved == [1, 2]
    assert contents(store_path) == contents(whole_store)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
@pytest.mark.slow
@pytest.mark.parametrize("calls", [3, 2 * ARRAYS + 20])
def test_killed_while_zarr_writes_a_file(study, study_file, whole_store, store_path, calls):
    """During creation of the store, and in the first chunk: the file that Zarr was writing has another name."""
    ended = in_another_process(KILLED_BY_ZARR.format(calls=calls), study_file, store_path, whole_store)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert [name for name in contents(store_path.parent) if name.endswith(".partial")]
    run_study(study, store_path)
    assert contents(store_path) == contents(whole_store)
    assert os.listdir(store_path.parent) == ["study.zarr"]


@pytest.mark.parametrize("where", ["before the mark", "in the mark"])
def test_stopped_before_or_during_the_completion_mark(study, whole_store, store_path, monkeypatch, where):
    """Interrupted between a chunk's arrays and its completion mark, or before the mark replaces the old one."""

    def stop(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if where == "before the mark":
            patch.setattr(Store, "_mark_finished", stop)
        else:
            patch.setattr(store_module.os, "fsync", stop)
        with pytest.raises(KeyboardInterrupt):
            run_study(study, store_path)
    assert not [name for name in os.listdir(store_path.parent) if name.endswith(".tmp")]
    if store_path.exists():
        assert study_progress(study, store_path).chunks == 0
    run_study(study, store_path)
    assert contents(store_path) == contents(whole_store)


@pytest.mark.slow
def test_a_full_disk_keeps_finished_chunks(study, whole_store, store_path, monkeypatch, watch_chunks):
    write = Store.write_array

    def full(self, name, points, values):
        if 2 in points and name == "mean":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, name, points, values)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write_array", full)
        with pytest.raises(OSError, match="No space left on device: a chunk could not be written; 1 of 3 chunks are"):
            run_study(study, store_path)
    assert study_progress(study, store_path).chunks == 1
    solved = watch_chunks()
    run_study(study, store_path)
    assert solved == [1, 2]
    assert contents(store_path) == contents(whole_store)


def test_a_file_size_limit_keeps_finished_chunks(study, whole_store, store_path, watch_chunks):
    """By a limit of the system: the last mark is slightly too long."""
    resource = pytest.importorskip("resource")
    earlier = resource.getrlimit(resource.RLIMIT_FSIZE)
    Store(study, store_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((whole_store / "zarr.json").stat().st_size - 10, earlier[1]))
    try:
        with pytest.raises(OSError, match=r"File too large: a chunk could not be written; 2 of 3 chunks are finished"):
            run_study(study, store_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, earlier)
    assert os.listdir(store_path.parent) == ["study.zarr"]
    assert study_progress(study, store_path).chunks == 2
    solved = watch_chunks()
    run_study(study, store_path)
    assert solved == [2]
    assert contents(store_path) == contents(whole_store)


def test_no_space_for_a_store(study, store_path):
    resource = pytest.importorskip("resource")
    earlier = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in (20, 400):  # neither for the lock nor for the complete store
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, earlier[1]))
        try:
            with pytest.raises(OSError, match=r"the study's store cannot be made \(File too large\)"):
                run_study(study, store_path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, earlier)
        assert os.listdir(store_path.parent) == []


def test_a_read_only_store(study, whole_store, monkeypatch):
    def refusing(path, flags, *rest, **options):
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return opened(path, flags, *rest, **options)

    opened = os.open
    before = contents(whole_store.parent)
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refusing)
        with pytest.raises(OSError, match=r"the study's store cannot be written \(Read-only file system\)"):
            run_study(study, whole_store)
        assert study_progress(study, whole_store).chunks == 3
        assert open_results(study, whole_store).finished.all()
    assert contents(whole_store.parent) == before


@pytest.mark.parametrize("damage", ["cut short", "changed", "lost"])
def test_a_damaged_chunk_is_solved_again(study, whole_store, store_path, watch_chunks, damage):
    shutil.copytree(whole_store, store_path)
    victim, other = store_path / "sensitivity/c/3/0", store_path / "sensitivity/c/0/0"
    if damage == "cut short":
        victim.write_bytes(victim.read_bytes()[:10])
    elif damage == "changed":
        victim.write_bytes(other.read_bytes())
    else:
        victim.unlink()
    assert open_results(study, store_path).finished.values.tolist() == [True, True, False, False, True, True]
    assert study_progress(study, store_path).points == 4
    solved = watch_chunks()
    run_study(study, store_path)
    assert solved == [1]
    assert contents(store_path) == contents(whole_store)


DAMAGED = {
    "cut short": lambda content: content[:500],
    "empty": lambda content: b"",
    "no text": lambda content: b"\xff\xfe",
    "no marks": lambda content: re.sub(rb'"finished": {[^}]*}', b'"finished": 5', content),
    "no format": lambda content: content.replace(b'"zarr_format": 3', b'"zarr_format": 7'),
    "no arrays": lambda content: re.sub(rb'"sensitivity": {', b'"sensitivity": {"node_type": 1}, "other": {', content),
}


@pytest.mark.parametrize("damage", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_store_is_not_reported_as_another_study(study, whole_store, store_path, damage):
    shutil.copytree(whole_store, store_path)
    file = store_path / "zarr.json"
    file.write_bytes(damage(file.read_bytes()))
    for use in (run_study, open_results, study_progress):
        with pytest.raises(
            ValueError, match=r"^\S+zarr\.json cannot be read .*the store is damaged.*run the study again"
        ):
            use(study, store_path)


@pytest.mark.slow
def test_a_lost_worker_loses_nothing(study, whole_store, store_path):
    distributed = pytest.importorskip("distributed")
    chunks = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):

        def kill_one(now):
            chunks.append(now.chunks)
            if now.chunks == 1:
                busy = max(client.processing().items(), key=lambda item: len(item[1]))[0]
                pids = client.run(os.getpid, workers=[busy])
                os.kill(pids[busy], signal.SIGKILL)

        data = run_study(study, store_path, client=client, progress=kill_one)
    assert chunks == [0, 1, 2, 3]
    assert data.finished.all()
    assert contents(store_path) == contents(whole_store)
