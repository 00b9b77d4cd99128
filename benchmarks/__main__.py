"""The command of the benchmarks: `python -m benchmarks [CASE …]` from the root of the repository.

Without a CASE, the command lists the cases. `README.md` in this folder explains what is measured and how.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from benchmarks.cases import NAMES, load
from benchmarks.harness import machine, report
from benchmarks.harness.case import MISSED, Case, Options, Result
from benchmarks.harness.run_case import CaseFailedError, run_apart, run_shared, shared_processes
from benchmarks.harness.tables import duration
from benchmarks.harness.timing import say


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the options of the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Lists the cases, or runs some.")
    parser.add_argument("cases", nargs="*", metavar="CASE", help="cases to run")
    parser.add_argument("--all", action="store_true", help="run every case")
    parser.add_argument("--write", action="store_true", help="write to RESULTS.md, the README's table and docs/")
    parser.add_argument("--quick", action="store_true", help="smoke runs on small problems, figures not judged")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="folder for the cases' figures")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write every result to this file")
    parser.add_argument("--without-pyeit", action="store_true", help="leave out pyEIT, which takes minutes")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="measured data (default ../shared/data)")
    parser.add_argument("--nodes", type=int, nargs="+", default=(), help="other sizes of meshes")
    parser.add_argument("--electrodes", type=int, nargs="+", default=(), help="other numbers of electrodes")
    parser.add_argument("--rounds", type=int, help="turns of each contestant at each task")
    parser.add_argument("--time-limit", type=float, metavar="S", help="limit of one call of a contestant")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.cases if name not in NAMES]
    if unknown:
        parser.error(f"there is no case {', '.join(unknown)}; there are {', '.join(NAMES)}")
    if options.all and options.cases:
        parser.error("give either --all or the names of cases")
    special = options.quick or options.nodes or options.electrodes or options.rounds or options.without_pyeit
    if options.write and special:
        parser.error(
            "--write keeps full runs only: leave out --quick, --nodes, --electrodes, --rounds, --without-pyeit"
        )
    if options.write and not (options.all or options.cases):
        parser.error("--write needs the names of cases, or --all")
    return options


def find(name: str) -> Case:
    """The benchmark case called `name`. Raises `CaseFailedError` if the module of the case cannot be imported."""
    try:
        return load(name)
    except ImportError as error:
        raise CaseFailedError(f"{name} cannot be imported: {error}") from error


def list_cases() -> None:
    """Print the name and description of every benchmark case."""
    for name in NAMES:
        try:
            case = find(name)
        except CaseFailedError as error:
            print(f"{name:20}{error}")
            continue
        print(f"{name:20}{case.description} ({case.minutes:g} min)")


Run = Callable[[str, Options], Result]


def measure(name: str, options: argparse.Namespace, run: Run) -> tuple[Result, list[str]]:
    """Run one case by the function `run`; return its result, and the heading that names the machine. Raises
    `CaseFailedError` if the case ends without a result."""
    case = find(name)
    pictures = machine.ROOT / "docs" / "images" if options.write and case.pictures else None
    case_options = Options(
        quick=options.quick,
        without_pyeit=options.without_pyeit,
        output=options.output.resolve() if options.output else pictures,
        data=options.data.resolve() if options.data else None,
        nodes=tuple(options.nodes),
        electrodes=tuple(options.electrodes),
        rounds=options.rounds,
        time_limit=options.time_limit,
    )
    if case_options.output is not None:
        case_options.output.mkdir(parents=True, exist_ok=True)
    say(f"== {name}: {case.description}")
    heading = machine.heading()
    return run(name, case_options), heading


def measure_all(names: Iterable[str], options: argparse.Namespace) -> Iterator[tuple[str, Callable]]:
    """Yield the name of each case when it is done, with a function that returns the result of `measure`.

    Cases that measure times run first, one after the other. The other cases then run in parallel, as many as there are
    cores, with one thread each: more would wait for each other. In a quick run, times are not judged, so all cases run
    in parallel, in processes that they share.
    """
    studies = []
    for name in names:
        try:
            timed = find(name).timed and not options.quick
        except CaseFailedError:
            timed = True
        if timed:
            yield name, partial(measure, name, options, partial(run_apart, threads=machine.CORES))
        else:
            studies.append(name)
    processes = shared_processes(machine.CORES) if options.quick else nullcontext()
    with processes as shared, ThreadPoolExecutor(machine.CORES) as pool:
        run = partial(run_apart, threads=1) if shared is None else partial(run_in, shared)
        futures = {pool.submit(measure, name, options, run): name for name in studies}
        for future in as_completed(futures):
            yield futures[future], future.result


def run_in(processes: ProcessPoolExecutor, name: str, options: Options) -> Result:
    """Run a case in one of several shared processes. Raises `CaseFailedError` if the case fails or crashes."""
    try:
        return processes.submit(run_shared, name, options).result()
    except BrokenExecutor as error:
        raise CaseFailedError(f"{name} was not run: a case has crashed its process; see the messages above.") from error


def keep(name: str, result: Result, heading: list[str], options: argparse.Namespace) -> None:
    """Print the report of a case and, if requested, write the report to files. Returns messages about failures."""
    print(f"\n## {name}\n\n{report.text(result, heading)}\n", flush=True)
    if options.write and not result.wrong:
        for line in report.write(load(name), result, heading, NAMES):
            say(line)


def main(arguments: list[str] | None = None) -> int:
    """Run the requested cases. Returns 1 if a case fails, if results disagree or, in a full run, if a required figure
    is missed."""
    options = parse(arguments)
    if not (options.all or options.cases):
        list_cases()
        return 0
    machine.use_cores()
    results: dict[str, Result] = {}
    failures, start = [], time.perf_counter()
    for name, answer in measure_all(NAMES if options.all else options.cases, options):
        try:
            results[name], heading = answer()
        except CaseFailedError as error:
            failures.append(str(error))
            say(str(error))
            continue
        keep(name, results[name], heading, options)
    for name, result in results.items():
        failures += [f"{name}: {line}" for line in result.wrong]
        failures += [f"{name}: missed: {one.asked}: {one.measured}" for one in result.asked if one.verdict == MISSED]
    if options.json:
        plain = {name: result.as_dict() for name, result in results.items()}
        options.json.write_text(json.dumps({"heading": machine.heading(), "cases": plain}, indent=1), encoding="utf-8")
    spent = ", ".join(f"{name} {duration(result.seconds)}" for name, result in results.items())
    say(f"{duration(time.perf_counter() - start)} in all: {spent}")
    for line in failures:
        say(line)
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
