"""Mutation testing: change the code in one place at a time, at random, and count the changes that a quick test detects.

    python -m pytest -n 2 -m 'not slow' --junitxml=tests.xml \\
        --cov=jeit --cov=jeit_solvers --cov-branch --cov-context=test --cov-report=
    python tests/mutants.py .coverage tests.xml --number 160 --output mutants.jsonl

This needs pytest-cov. Each mutant differs from the code in one operator, number or condition. The tests that reach its
line are run, quickest first and as many as fit into `--budget` seconds, until one fails or hangs: then the mutant is
killed. Equal numbers of mutants are drawn in each subpackage, and equal seeds draw equal mutants of equal code. Results
are appended to the output as they come, and mutants that it already holds are not run again, so that a run can be
interrupted. A table by subpackage is printed at the end.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from xml.etree import ElementTree

from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (ROOT / "jeit", ROOT / "solvers" / "jeit_solvers")
OTHER = {ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"), ast.Eq: ("==", "!=")}
OTHER |= {ast.NotEq: ("!=", "=="), ast.In: ("in", "not in"), ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is")}
OTHER |= {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.Pow: ("**", "*")}
OTHER |= {ast.Mod: ("%", "*"), ast.FloorDiv: ("//", "*"), ast.And: ("and", "or"), ast.Or: ("or", "and")}
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum"}


def mutants_of(path: Path):
    """Yield every mutant of a file: the line of its statement, the range of characters to replace, and the
    replacement."""
    text = path.read_text("utf-8")
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def span(node, end=False):
        return starts[(node.end_lineno if end else node.lineno) - 1] + (node.end_col_offset if end else node.col_offset)

    def between(left, right, kind):
        """Return the position of an operator between two expressions."""
        old, new = OTHER[kind]
        at = text.encode().find(old.encode(), span(left, end=True), span(right))
        return [(at, at + len(old.encode()), new)] if at >= 0 else []

    def changes(node):
        match node:
            case ast.Compare(ops=[one]) if type(one) in OTHER:
                return between(node.left, node.comparators[0], type(one))
            case ast.BinOp() if type(node.op) in OTHER:
                return between(node.left, node.right, type(node.op))
            case ast.BoolOp():
                return between(node.values[0], node.values[1], type(node.op))
            case ast.UnaryOp(op=ast.USub()):
                return [(span(node), span(node) + len("-"), "")]
            case ast.UnaryOp(op=ast.Not()):
                return [(span(node), span(node) + len("not"), "")]
            case ast.Constant(value=bool(value)):
                return [(span(node), span(node, end=True), str(not value))]
            case ast.Constant(value=int() | float() as value):
                return [
                    (span(node), span(node, end=True), repr(value + 1 if isinstance(value, int) else 2 * value + 1))
                ]
            case ast.If() | ast.IfExp():
                return [(span(node.test), span(node.test, end=True), f"not ({ast.unparse(node.test)})")]
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in NAMES:
                end = span(node.func, end=True)
                return [(end - len(name), end, NAMES[name])]
        return []

    def walk(node, line):
        if isinstance(node, ast.stmt):
            line = node.lineno
        for at, end, new in changes(node):
            yield line, at, end, new
        for field, value in ast.iter_fields(node):
            if field not in ("annotation", "returns"):  # annotations are not executed
                for child in value if isinstance(value, list) else [value]:
                    if isinstance(child, ast.AST):
                        yield from walk(child, line)

    yield from walk(ast.parse(text), 1)


def drawn(number: int, seed: int):
    """Draw at least this many mutants, equally many in each subpackage, in random order."""
    rooms = defaultdict(list)
    for package in PACKAGES:
        for path in sorted(package.rglob("*.py")):
            inside = path.relative_to(package).parts
            room = package.name if package.name != "jeit" else inside[0] if len(inside) > 1 else "jeit"
            rooms[room] += [(room, str(path.relative_to(ROOT)), *one) for one in mutants_of(path)]
    each, found = -(-number // len(rooms)), []
    for room in sorted(rooms):
        found += random.Random(f"{seed} {room}").sample(rooms[room], min(each, len(rooms[room])))
    random.Random(seed).shuffle(found)
    return found


def tests_of(data: CoverageData, path: str, line: int) -> set[str]:
    """Return the tests that reach a line; for a line that runs only on import, the tests that reach any line of its
    file."""
    (measured,) = [one for one in data.measured_files() if one.endswith(path)] or [None]
    if measured is None:
        return set()
    by_line = data.contexts_by_lineno(measured)
    there = {one.split("|")[0] for one in by_line.get(line, ()) if one}
    return there or {one.split("|")[0] for every in by_line.values() for one in every if one}


def run(copy: Path, mutant, tests, budget: float) -> str:
    """Return "killed", "hangs", "survived" or "not reached"."""
    _, name, _, at, end, new = mutant
    if not tests:
        return "not reached"
    original = (copy / name).read_bytes()
    chosen = copy / "chosen.txt"
    chosen.write_text("\n".join(tests))
    plugins = ["-p", "no:cacheprovider", "-p", "no:randomly", "-p", "no:xdist"]
    command = [sys.executable, "-m", "pytest", "-x", "-q", *plugins, "-o", "addopts=", f"@{chosen}"]
    paths = os.pathsep.join([str(copy), str(copy / "solvers")])
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        (copy / name).write_bytes(original[:at] + new.encode() + original[end:])
        with open(copy / "log.txt", "w") as log:
            settings = {"env": environment, "stdout": log, "stderr": log, "timeout": 4 * budget + 60}
            done = subprocess.run(command, cwd=copy, check=False, **settings)
        return "survived" if done.returncode == 0 else "killed"
    except subprocess.TimeoutExpired:
        return "hangs"
    finally:
        (copy / name).write_bytes(original)


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("coverage", type=Path)
    parser.add_argument("durations", type=Path, help="what pytest wrote by --junitxml")
    parser.add_argument("--number", type=int, default=160)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget", type=float, default=60, help="seconds of tests for each mutant")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("mutants.jsonl"))
    asked = parser.parse_args()
    data = CoverageData(str(asked.coverage))
    data.read()
    seconds = {}
    for case in ElementTree.parse(asked.durations).iter("testcase"):
        parts, name = case.get("classname", "").split("."), case.get("name", "")
        file = next(n for n in range(len(parts), 0, -1) if (ROOT / Path(*parts[:n]).with_suffix(".py")).exists())
        test = "::".join([str(Path(*parts[:file]).with_suffix(".py")), *parts[file:], name])
        seconds[test] = float(case.get("time", 0))
    before = asked.output.read_text("utf-8").splitlines() if asked.output.exists() else []
    done = {tuple(one["mutant"]): one for one in map(json.loads, before)}
    mutants, copies = drawn(asked.number, asked.seed), SimpleQueue()
    print(f"{len(mutants)} mutants, of seed {asked.seed}; {len(done)} have been run", flush=True)

    def one(mutant):
        if mutant in done:
            return
        known = sorted((seconds[test], test) for test in tests_of(data, *mutant[1:3]) & seconds.keys())
        spent, tests = 0.0, []
        for time, test in known:
            if (spent := spent + time) > asked.budget and tests:
                break
            tests.append(test)
        copy = copies.get()
        try:
            result = run(copy, mutant, tests, asked.budget)
        finally:
            copies.put(copy)
        done[mutant] = {"mutant": mutant, "result": result, "tests": len(tests), "of": len(known)}
        with asked.output.open("a", encoding="utf-8") as file:
            file.write(json.dumps(done[mutant]) + "\n")
        print(f"{len(done)}: {result}, {mutant[1]}:{mutant[2]} → {mutant[5]!r}, {len(tests)} tests", flush=True)

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(asked.jobs) as pool:
        for number in range(asked.jobs):
            copy = Path(folder) / str(number) / "jeit"
            ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".jax_cache", "out", "site")
            shutil.copytree(ROOT, copy, ignore=ignored)
            copies.put(copy)
        list(pool.map(one, mutants))
    table = defaultdict(lambda: defaultdict(int))
    for mutant in mutants:
        for room in (mutant[0], "all"):
            table[room]["all"] += 1
            table[room]["killed"] += done[mutant]["result"] in ("killed", "hangs")
    for room, count in table.items():
        print(f"{room:15} {count['killed']:4} of {count['all']:4}, {count['killed'] / count['all']:.0%}")


if __name__ == "__main__":
    main()
