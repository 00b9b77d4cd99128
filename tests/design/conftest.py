"""A study, its store after an undisturbed run, and a monitor of the chunks that are solved."""

from collections.abc import Callable
from pathlib import Path

import pytest
from studies import SWEEP

from jeit.design.study import Study, read_study, run_study
from jeit.design.study import run as run_module


@pytest.fixture(scope="session")
def study_file(tmp_path_factory) -> Path:
    """The sweep as a file."""
    path = tmp_path_factory.mktemp("study") / "study.toml"
    path.write_text(SWEEP, "utf-8")
    return path


@pytest.fixture(scope="session")
def study(study_file) -> Study:
    """The sweep."""
    return read_study(study_file)


@pytest.fixture(scope="session")
def whole_store(study, study_file) -> Path:
    """The store of an undisturbed run of the sweep."""
    run_study(study, study_file.parent / "whole.zarr")
    return study_file.parent / "whole.zarr"


@pytest.fixture
def store_path(tmp_path) -> Path:
    """A path for a store."""
    return tmp_path / "study.zarr"


@pytest.fixture
def watch_chunks(monkeypatch) -> Callable[[], list[int]]:
    """Call it to get the numbers of the chunks that are solved from then on."""

    def watch() -> list[int]:
        solved, solve = [], run_module.solve_chunk
        monkeypatch.setattr(
            run_module, "solve_chunk", lambda study, number, *rest: solved.append(number) or solve(study, number, *rest)
        )
        return solved

    return watch
