"""Run one case in a separate process: `python -m benchmarks.harness.run_case NAME OPTIONS.pickle RESULT.json`.

Each case thus has its own memory and no compiled code, and a case that crashes does not affect the others. Quick cases,
which are not judged, are run one after the other in a few processes, and share modules and compiled code.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import subprocess
import sys
import tempfile
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from benchmarks.harness.case import MET, MISSED, NOT_JUDGED, Options, Result
from benchmarks.harness.machine import ROOT, same_for_all
from benchmarks.harness.memory import peak_memory


class CaseFailedError(Exception):
    """Error raised if a case ended without a result."""


def run_apart(name: str, options: Options, threads: int) -> Result:
    """Run a case in a separate process, with `threads` threads of linear algebra, and return the result. Raises
    `CaseFailedError` if the process ends without a result."""
    with tempfile.TemporaryDirectory() as folder:
        option_file, answer = Path(folder, "options"), Path(folder, "result")
        option_file.write_bytes(pickle.dumps(options))
        command = [sys.executable, "-m", "benchmarks.harness.run_case", name, str(option_file), str(answer)]
        ended = subprocess.run(command, cwd=ROOT, env=same_for_all(threads), check=False)
        if ended.returncode != 0 or not answer.is_file():
            raise CaseFailedError(f"{name} ended with exit code {ended.returncode}; see the messages above.")
        return Result.from_dict(json.loads(answer.read_text(encoding="utf-8")))


def shared_processes(number: int) -> ProcessPoolExecutor:
    """A `number` of processes for `run_shared`, with a thread of linear algebra each."""
    os.environ |= same_for_all(1, compiled=True)
    return ProcessPoolExecutor(number, mp_context=multiprocessing.get_context("spawn"))


def run_shared(name: str, options: Options) -> Result:
    """Run a case in one of the shared processes, and return the result. Raises `CaseFailedError`, with the traceback,
    if the case fails."""
    try:
        return run_here(name, options)
    except Exception:  # of any kind; the process goes on with the next case
        raise CaseFailedError(f"{name} failed:\n{traceback.format_exc()}") from None


def run_here(name: str, options: Options) -> Result:
    """Run a case in this process and return the result, with the seconds and the peak memory of this process. Figures
    of a quick run are not judged."""
    from benchmarks.cases import load

    start = time.perf_counter()
    result = load(name).run(options)
    result.seconds = time.perf_counter() - start
    result.peak_memory = peak_memory()
    for one in result.asked:
        if options.quick and one.verdict in (MET, MISSED):
            one.verdict = NOT_JUDGED
    return result


def main() -> None:
    """Run the case that the command line names, and save the result."""
    name, option_file, answer = sys.argv[1:]
    result = run_here(name, pickle.loads(Path(option_file).read_bytes()))
    Path(answer).write_text(json.dumps(result.as_dict()), encoding="utf-8")


if __name__ == "__main__":
    main()
