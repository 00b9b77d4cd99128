"""Contestants in their processes: taking turns, their results, and one that does not run."""

import sys

import numpy as np
import pytest

from benchmarks.harness.contest import Contestant, GaveUpError, compete, results_in
from benchmarks.harness.timing import least_times, timed
from benchmarks.problems import matrices


@pytest.fixture(scope="module")
def problem():
    """Three matrices of a chain of 40 springs, in the form that solvers receive."""
    size, random = 40, np.random.default_rng(0)
    below = np.arange(1, size)
    rows, columns = np.concatenate([np.arange(size), below]), np.concatenate([np.arange(size), below - 1])
    stiffness = random.uniform(1.0, 2.0, (3, size - 1))
    diagonal = np.ones((3, size))
    diagonal[:, 1:] += stiffness
    diagonal[:, :-1] += stiffness
    values = np.concatenate([diagonal, -stiffness], axis=1)
    return {"rows": rows, "columns": columns, "values": values, "load": random.normal(size=(size, 16))}


def test_a_matrix_is_complete_and_symmetric(problem):
    matrix = matrices.symmetric(problem, 1)
    assert abs(matrix - matrix.T).max() == 0
    assert np.linalg.eigvalsh(matrix.toarray()).min() >= 1.0 - 1e-12


def test_contestants_take_turns_and_save_their_results(problem, tmp_path):
    np.savez(tmp_path / "problem.npz", **problem)
    with Contestant("SuperLU", tmp_path / "problem.npz", 60.0) as one:
        assert one.description.startswith("SciPy")
        assert one.details["factor MB"] > 0
        figures = compete([one], "factorise and solve", rounds=2, budget=5.0, folder=tmp_path)["SuperLU"]
        assert len(figures.seconds) >= 2
        assert figures.peak is None or figures.peak > 10
        assert figures.remark == ""
        (solution,) = results_in(tmp_path / "SuperLU.npz")
        assert matrices.residual(problem, 0, solution) < 1e-13
        (batch,) = one.save("batch", tmp_path / "batch.npz")
        assert [matrices.residual(problem, k, batch[k]) < 1e-13 for k in range(3)] == [True] * 3
        # It fails at a problem that it cannot solve, and is excluded.
        with pytest.raises(GaveUpError, match="KeyError"):
            one.ask(do="first", task="juggle")
        again = compete([one], "solve", rounds=1, budget=1.0)["SuperLU"]
        assert again.remark == "not running"
        assert np.isnan(again.median)


def test_one_that_does_not_run_is_excluded(tmp_path, problem):
    np.savez(tmp_path / "problem.npz", **problem)
    with pytest.raises(GaveUpError, match="KeyError"):
        Contestant("nobody", tmp_path / "problem.npz", 60.0, sys.executable)


def test_compilation_is_measured_apart_and_a_budget_ends_the_repeats():
    calls = []

    def slow_at_first():
        calls.append(len(calls))
        return np.linalg.inv(np.eye(400)).sum() if len(calls) == 1 else 1.0

    found = timed(slow_at_first, 4)
    assert len(calls) == 5
    assert found.compile > 0
    assert found.answer == 1.0
    calls.clear()
    timed(slow_at_first, 100, budget=0.0)
    assert len(calls) == 2
    least = least_times({"one": slow_at_first, "other": slow_at_first}, repeats=3)
    assert list(least) == ["one", "other"]
    assert min(least.values()) < 1.0
