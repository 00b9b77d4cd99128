"""`jeit study`: run, resume, status and report, and one line for every fault."""

import errno
import os
import signal
import sys

import numpy as np
import pytest
from studies import SMALL

from jeit.design.study import read_study
from jeit.design.study import run as study_run
from jeit.design.study.lock import lock_store
from jeit.design.study.store import Store

pytest.importorskip("xarray")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text(SMALL, "utf-8")
    return path


def failed(result):
    status, _, error = result
    assert status == 1
    assert error.startswith("jeit: ")
    assert error.count("\n") == 1
    return error


@pytest.fixture
def drawn(monkeypatch):
    """The results of every chunk are drawn, since tests/design/test_study_results.py proves how they are solved."""

    def solve_chunk(study, number, *_):
        sensitivity = np.random.default_rng(number).uniform(1e-4, 1e-3, (1, study.columns * study.rows))
        least, mean = sensitivity.min(axis=1), sensitivity.mean(axis=1)
        uniformity = mean / np.sqrt((sensitivity**2).mean(axis=1))
        return {"sensitivity": sensitivity, "minimum": least, "mean": mean, "uniformity": uniformity}

    monkeypatch.setattr(study_run, "solve_chunk", solve_chunk)


@pytest.mark.usefixtures("drawn")
def test_run_stop_resume_and_report(file, run, monkeypatch):
    assert "not begun; 2 points in 2 chunks" in run("study", "status", file)[1]
    assert "begin with 'jeit study run" in failed(run("study", "resume", file))
    assert "no study at" in failed(run("study", "report", file))
    write = Store.write_array

    def full(self, name, points, values):
        if 1 in points:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(self, name, points, values)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write_array", full)
        error = failed(run("study", "run", file, "--quiet"))
    assert "sweep.zarr: No space left on device: a chunk could not be written; 1 of 2 chunks are finished" in error
    assert "1 of 2 points finished, in 1 of 2 chunks" in run("study", "status", file)[1]
    assert "there already: 'jeit study resume" in failed(run("study", "run", file))
    status, out, _ = run("study", "resume", file)
    assert status == 0
    assert "2/2" in out
    assert "Written:" in out
    assert file.with_suffix(".html").stat().st_size > 10_000
    assert "2 of 2 points finished" in run("study", "status", file)[1]
    status, out, _ = run("study", "report", file, "--page", file.parent / "other.html")
    assert (status, (file.parent / "other.html").is_file()) == (0, True)
    error = failed(run("study", "report", file, "--page", file.parent / "none" / "other.html"))
    assert "there is no folder" in error
    error = failed(run("study", "report", file, "--page", file))
    assert "that is the study itself" in error
    assert "[electrodes]" in file.read_text()
    assert "something else already" in failed(run("study", "run", file, "--output", file))
    file.write_text(SMALL.replace("rows = 5", "rows = 6"), "utf-8")
    assert "another study, or of this one before it was changed" in failed(run("study", "resume", file))


@pytest.mark.slow
def test_a_stopped_study_is_resumed(file, run, monkeypatch):
    def stopped(*_):
        signal.raise_signal(signal.SIGINT)

    for output, asked in ((), ""), (("--output", file.parent / "o.zarr"), f" --output {file.parent / 'o.zarr'}"):
        with monkeypatch.context() as patch:
            patch.setattr(Store, "write_array", stopped)
            status, _, error = run("study", "run", file, "--quiet", *output)
        assert (status, error) == (130, f"jeit: stopped; 'jeit study resume {file}{asked}' goes on with it.\n")
    assert run("study", "resume", file, "--quiet")[0] == 0


@pytest.mark.parametrize("command", ["run", "resume"])
def test_a_study_that_another_process_writes_is_refused(file, run, command):
    store = Store(read_study(file), file.with_suffix(".zarr"))
    with lock_store(store.path, "study"):
        assert f"{store.path} is being written by this process since " in failed(run("study", command, file, "-q"))
        assert "0 of 2 points finished" in run("study", "status", file)[1]
        assert "no chunk of the study is finished" in failed(run("study", "report", file))


@pytest.mark.parametrize("command", ["resume", "status", "report"])
def test_a_folder_without_a_study_is_refused(file, run, command):
    folder = file.parent / "letters"
    folder.mkdir()
    (folder / "letter.txt").write_text("dear")
    status, out, error = run("study", command, file, "-o", folder)
    assert (status, out) == (1, "")
    assert error == (
        f"jeit: {folder} holds no study: name the store that 'jeit study run' wrote, or, for a new one, a place where "
        "nothing is.\n"
    )
    assert [path.name for path in folder.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize("command", ["resume", "status", "report"])
def test_a_damaged_store_is_reported(file, run, command):
    store = Store(read_study(file), file.with_suffix(".zarr"))
    (store.path / "zarr.json").write_text('{"zarr_format": 3, "node', "utf-8")
    error = failed(run("study", command, file))
    assert f"{store.path / 'zarr.json'} cannot be read" in error
    assert "Put that file back from a copy; or move the store away and run the study again." in error


@pytest.mark.parametrize("command", ["run", "resume", "status", "report"])
def test_bad_studies_are_refused_in_one_line(file, run, command):
    file.write_text(SMALL + "cel_mm = 5\n", "utf-8")
    assert "sweep.toml: mesh.cel_mm is no key of a study (did you mean 'cell_mm'?)" in failed(
        run("study", command, file)
    )
    assert not file.with_suffix(".zarr").exists()


def test_faults_are_reported_before_the_study_runs(file, run):
    assert "no file" in failed(run("study", "run", file.parent / "none.toml"))
    assert "cannot be made" in failed(run("study", "run", file, "--output", file / "in a file.zarr"))
    page = file.parent / "none" / "page.html"
    assert f"there is no folder {page.parent}" in failed(run("study", "run", file, "--page", page))
    assert not file.with_suffix(".zarr").exists()
    assert run("study", "rerun", file)[0] == 2


def test_a_missing_package_is_reported_with_its_extra(file, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert "a study needs zarr: pip install 'jeit[cluster]'" in failed(run("study", "run", file))


def test_help_without_a_command(run):
    status, out, _ = run("study")
    assert status == 0
    for command in ("run", "resume", "status", "report"):
        assert command in out
