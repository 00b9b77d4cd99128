"""Compilation levels of commands: quick, except for commands that run one program many times, unless the user sets
flags."""

import gc
import os

import pytest

from jeit.cli.app import main


@pytest.fixture
def flags_of(monkeypatch):
    """XLA's flags after a command was run in this process."""
    threshold = gc.get_threshold()

    def run(*words):
        monkeypatch.setattr("sys.argv", ["jeit", *words, "--help"])
        assert main() == 0
        return os.environ.get("XLA_FLAGS")

    monkeypatch.setenv("XLA_FLAGS", "")  # restore what the command sets
    monkeypatch.delenv("XLA_FLAGS")
    yield run
    gc.set_threshold(*threshold)


@pytest.mark.parametrize("words", [["demo"], ["reconstruct"], ["layout", "compare"], ["locate"], []])
def test_single_runs_are_compiled_quickly(flags_of, words):
    assert "--xla_backend_optimization_level=0" in flags_of(*words)


@pytest.mark.parametrize("words", [["stream"], ["study", "run"], ["study", "resume"], ["layout", "optimise"]])
def test_repeated_runs_are_compiled_with_optimisation(flags_of, words):
    assert flags_of(*words) is None


def test_flags_of_the_user_are_kept(flags_of, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert flags_of("demo") == "--xla_cpu_enable_fast_math=false"
