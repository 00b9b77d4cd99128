"""Propose quick tests for `repeated.txt`: long ones whose lines and branches shorter quick tests reach as well.

    python -m pytest -n 2 -m 'not slow' --junitxml=tests.xml \\
        --cov=jeit --cov=jeit_solvers --cov-branch --cov-context=test --cov-report=
    python tests/find_repeated.py .coverage tests.xml

This needs pytest-cov. The longest tests are examined first. A test is proposed if each branch that it takes is also
taken by a test that stays quick. One case of each parametrised test stays. A proposed test that alone compares a result
with a closed solution, finite differences or another library should stay quick too, unless it takes over 3 s.
"""

from __future__ import annotations

import argparse
import sqlite3
from collections import Counter, defaultdict
from pathlib import Path
from xml.etree import ElementTree


def branches_by_test(coverage: Path) -> tuple[dict[str, list], Counter]:
    """Return the branches that each test takes, and the number of times that each branch is taken by a test or a
    fixture."""
    branches = defaultdict(list)
    counts = Counter()
    with sqlite3.connect(coverage) as database:
        contexts = dict(database.execute("select id, context from context"))
        for file, context, start, end in database.execute("select file_id, context_id, fromno, tono from arc"):
            test, _, phase = contexts[context].rpartition("|")
            counts[file, start, end] += 1
            if phase == "run":
                branches[test].append((file, start, end))
    return branches, counts


def seconds_by_test(results: Path) -> dict[str, float]:
    """Return the seconds of each test by its identifier, from a file of --junitxml."""
    cases = ElementTree.parse(results).iter("testcase")
    return {
        f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}": float(case.get("time", 0))
        for case in cases
    }


def find_repeated(coverage: Path, results: Path, shortest: float) -> dict[str, float]:
    """Return the tests that may be left to the slow set, with their seconds."""
    branches, counts = branches_by_test(coverage)
    seconds = seconds_by_test(results)
    remaining_cases = Counter(test.partition("[")[0] for test in seconds)
    repeated = {}
    for test in sorted(seconds, key=lambda test: -seconds[test]):
        function, is_case, _ = test.partition("[")
        is_last_case = is_case and remaining_cases[function] == 1
        if seconds[test] >= shortest and not is_last_case and all(counts[branch] > 1 for branch in branches[test]):
            repeated[test] = seconds[test]
            remaining_cases[function] -= 1
            counts.subtract(branches[test])
    return repeated


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("coverage", type=Path, help="file of pytest-cov, with branches and contexts")
    parser.add_argument("results", type=Path, help="file of --junitxml")
    parser.add_argument("--shortest", type=float, default=0.3, help="tests of fewer seconds stay quick")
    options = parser.parse_args()
    tests = find_repeated(options.coverage, options.results, options.shortest)
    print(*sorted(tests), sep="\n")
    print(f"# {len(tests)} tests, {sum(tests.values()):.0f} s")
