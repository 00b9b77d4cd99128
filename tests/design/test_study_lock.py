"""Only one process at a time writes a store: lock owners are named, dead ones detected, and leftovers removed."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from studies import contents

from jeit.design.study import lock as lock_module
from jeit.design.study import open_results, run_study, study_progress
from jeit.design.study.lock import lock_store

pytest.importorskip("xarray")
pytest.importorskip("zarr")

HOLDS = """
import sys, time
from pathlib import Path
from jeit.design.study.lock import lock_store
with lock_store(Path(sys.argv[1]), "study"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def lock_file(store_path):
    """Path of the store's lock."""
    return store_path.with_name(".study.zarr.lock")


@pytest.fixture
def other_process(store_path):
    """Another process that holds the lock."""
    process = subprocess.Popen([sys.executable, "-c", HOLDS, store_path], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def signed(lock_file, **owner):
    """A lock with this text about its owner, as if left behind."""
    owner_record = {"pid": 4242, "host": "elsewhere", "boot": "another", "since": "2026-01-02 03:04:05+00:00"} | owner
    lock_file.write_text(json.dumps(owner_record))


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_running_owner_is_named_and_a_dead_one_detected(study, store_path, lock_file, other_process):
    message = rf"^{re.escape(str(store_path))} is being written by process {other_process.pid} since \d{{4}}-\d\d-\d\d "
    with pytest.raises(ValueError, match=message):
        run_study(study, store_path)
    assert not store_path.exists()
    other_process.send_signal(signal.SIGKILL)
    other_process.wait()
    assert lock_file.exists()
    with lock_store(store_path, "study"):
        assert json.loads(lock_file.read_text())["pid"] == os.getpid()
    assert not lock_file.exists()


def test_reading_needs_no_lock_and_a_second_writer_is_refused(study, whole_store, lock_file):
    with lock_store(whole_store, "study"):
        assert study_progress(study, whole_store).chunks == 3
        assert open_results(study, whole_store).finished.all()
        with pytest.raises(ValueError, match=r"being written by this process since .* then resume the study"):
            run_study(study, whole_store)
    run_study(study, whole_store)


def test_a_link_to_a_store_has_its_lock(store_path, whole_store):
    store_path.symlink_to(whole_store)
    with (
        lock_store(whole_store, "study"),
        pytest.raises(ValueError, match="being written by this process"),
        lock_store(store_path, "study"),
    ):
        pass


def test_a_lock_of_another_machine_explains_how_to_remove_it(study, whole_store):
    lock_file = whole_store.with_name(f".{whole_store.name}.lock")
    signed(lock_file)
    with pytest.raises(
        ValueError, match=r"process 4242 on 'elsewhere' since 2026-01-02.* where it does not, delete "
    ) as e:
        run_study(study, whole_store)
    assert str(lock_file) in str(e.value)
    lock_file.unlink()
    run_study(study, whole_store)


@pytest.mark.parametrize(
    "left", ["nothing", "no JSON", "a list", "before this machine started", "another name of this machine"]
)
def test_abandoned_locks_are_taken_over(store_path, lock_file, left):
    if left == "before this machine started":
        signed(lock_file, host=lock_module.platform.node())
    elif left == "another name of this machine":
        if not lock_module.boot_identifier():
            pytest.skip("this system does not distinguish its boots")
        signed(lock_file, boot=lock_module.boot_identifier())
    else:
        lock_file.write_text({"nothing": "", "no JSON": "{" * 5000, "a list": "[1]"}[left])
    with lock_store(store_path, "study"):
        assert json.loads(lock_file.read_text())["pid"] == os.getpid()


def test_on_file_systems_without_locks(store_path, lock_file, monkeypatch):
    monkeypatch.setattr(lock_module, "fcntl", None)
    signed(lock_file, host=lock_module.platform.node(), pid=os.getpid())
    with (
        pytest.raises(ValueError, match=f"process {os.getpid()} on this machine since .* delete "),
        lock_store(store_path, "study"),
    ):
        pass
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    signed(lock_file, host=lock_module.platform.node(), pid=ended.pid)
    with lock_store(store_path, "study"):
        assert json.loads(lock_file.read_text())["pid"] == os.getpid()


def test_a_link_is_not_followed_for_writing(store_path, lock_file, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    lock_file.symlink_to(tmp_path / "letter.txt")
    with pytest.raises(OSError, match="the study's store cannot be made"), lock_store(store_path, "study"):
        pass
    assert (tmp_path / "letter.txt").read_text() == "dear"


def test_leftovers_of_killed_runs_are_removed(study, whole_store, store_path):
    run_study(study, store_path)
    beside, inside = store_path.parent, store_path / "sensitivity" / "c" / "0"
    (beside / ".study.zarr.4242.tmp").write_text("{")
    (beside / ".study.zarr.4242.new").mkdir()
    (beside / ".study.zarr.4242.new" / "zarr.json").write_text("{")
    (inside / "0.0123456789abcdef.partial").write_bytes(b"half")
    for name in (".study.zarr.notes", "study.zarr.4242.tmp", ".other.zarr.4242.tmp"):
        (beside / name).write_text("mine")
    run_study(study, store_path)
    assert contents(store_path) == contents(whole_store)
    assert sorted(os.listdir(beside)) == [
        ".other.zarr.4242.tmp",
        ".study.zarr.notes",
        "study.zarr",
        "study.zarr.4242.tmp",
    ]


def test_nothing_is_removed_from_a_folder_that_is_no_store(study, store_path):
    store_path.mkdir()
    (store_path / "film.partial").write_text("mine")
    with pytest.raises(ValueError, match="holds no study"):
        run_study(study, store_path)
    assert (store_path / "film.partial").read_text() == "mine"
    assert os.listdir(store_path.parent) == ["study.zarr"]


def test_a_clock_that_was_set_back_does_no_harm(study, whole_store, store_path, monkeypatch):
    now = [2e9]

    def backwards():
        now[0] -= 1e6
        return now[0]

    monkeypatch.setattr(time, "time", backwards)
    monkeypatch.setattr(time, "time_ns", lambda: int(1e9 * backwards()))
    run_study(study, store_path)
    assert contents(store_path) == contents(whole_store)
