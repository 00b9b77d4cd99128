"""The benchmarks' command: its list, the arguments that it refuses, and the other cases after one fails."""

import ast
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks.cases import NAMES, load
from benchmarks.harness.case import MISSED, Asked, Options, Result, Table
from benchmarks.harness.run_case import CaseFailedError, run_apart, run_here, run_shared

ROOT = Path(__file__).resolve().parents[2]


def test_cases_are_listed_with_a_line_each(capsys):
    assert command.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(NAMES)
    for name in NAMES:
        case = load(name)
        assert case.name == name
        assert "\n" not in case.description
        assert case.minutes > 0


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["--write"],
        ["--all", "--write", "--quick"],
        ["--all", "first_call"],
        ["first_call", "--nodes", "9", "--write"],
    ],
)
def test_refuses_arguments_that_cannot_be_satisfied(arguments, capsys):
    with pytest.raises(SystemExit):
        command.main(arguments)
    assert "error" in capsys.readouterr().err


def test_a_case_that_fails_does_not_lose_the_others(monkeypatch, capsys):
    ran, threads_of = [], {}

    def apart(name, options, threads):
        ran.append(name)
        threads_of[name] = threads
        if name == "solver":
            raise CaseFailedError("solver ended with exit code 1")
        return Result([Table(["what"], [[name]])], [Asked("as quick as that", "slower", MISSED)])

    monkeypatch.setattr(command, "run_apart", apart)
    monkeypatch.setattr(command.machine, "use_cores", lambda: None)
    assert command.main(["ktc2023", "solver", "design_figures", "first_call"]) == 1
    # Cases that measure times come first and alone.
    assert ran[:2] == ["solver", "first_call"]
    assert set(ran[2:]) == {"ktc2023", "design_figures"}
    # Cases side by side have one thread of linear algebra each, or they would wait for each other.
    assert threads_of == {"solver": 2, "first_call": 2, "ktc2023": 1, "design_figures": 1}
    printed = capsys.readouterr()
    assert "| first_call |" in printed.out
    assert "solver ended" in printed.err
    assert "first_call: missed: as quick as that: slower" in printed.err


def test_a_quick_case_is_measured_and_not_judged():
    result = run_here("first_call", Options(quick=True))
    assert [one.verdict for one in result.asked] == ["not judged"]
    assert result.seconds > 0
    assert Result.from_dict(result.as_dict()) == result


def test_a_case_in_a_process_of_its_own_may_fail():
    with pytest.raises(CaseFailedError, match="nonsense ended with exit code 1"):
        run_apart("nonsense", Options(quick=True), threads=1)


def test_quick_cases_share_processes_and_one_that_fails_does_not_lose_the_others(monkeypatch, capsys):
    def run(name, options):
        return run_shared("nonsense" if name == "solver" else name, options)

    monkeypatch.setattr(command, "shared_processes", ThreadPoolExecutor)
    monkeypatch.setattr(command, "run_shared", run)
    monkeypatch.setattr(command.machine, "use_cores", lambda: None)
    assert command.main(["--quick", "solver", "real_skins"]) == 1
    printed = capsys.readouterr()
    assert "## real_skins" in printed.out
    assert "nonsense failed:" in printed.err
    assert "Traceback" in printed.err


def test_nothing_imports_the_tests():
    for path in (ROOT / "benchmarks").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in names if name.split(".")[0] == "tests"], path
