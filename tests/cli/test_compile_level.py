"""How commands have their programs compiled: quickly, unless they run one program again and again, or the user says."""

import gc
import os

import pytest

from jeit.cli.app import main


@pytest.fixture
def flags_of(monkeypatch):
    """XLA's flags after a command of the process was run."""
    threshold = gc.get_threshold()

    def run(*words):
        monkeypatch.setattr("sys.argv", ["jeit", *words, "--help"])
        assert main() == 0
        return os.environ.get("XLA_FLAGS")

    monkeypatch.setenv("XLA_FLAGS", "")  # so that what the command sets is undone
    monkeypatch.delenv("XLA_FLAGS")
    yield run
    gc.set_threshold(*threshold)


@pytest.mark.parametrize("words", [["demo"], ["reconstruct"], ["layout", "compare"], ["locate"], []])
def test_what_runs_once_is_compiled_quickly(flags_of, words):
    assert "--xla_backend_optimization_level=0" in flags_of(*words)


@pytest.mark.parametrize("words", [["stream"], ["study", "run"], ["study", "resume"], ["layout", "optimise"]])
def test_what_runs_again_and_again_is_compiled_well(flags_of, words):
    assert flags_of(*words) is None


def test_the_users_own_flags_stand(flags_of, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert flags_of("demo") == "--xla_cpu_enable_fast_math=false"
