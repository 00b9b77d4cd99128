"""Worker: runs one contestant in a separate process, reads commands from standard input and writes answers to standard
output, as JSON lines.

Run as `python -m benchmarks.harness.worker CONTESTANT PROBLEM.npz`. Separate processes allow pyEIT and sparsax to have
their own environments, memory to be measured for each contestant, and turns to be interleaved.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
import traceback
from pathlib import Path

import numpy as np

from benchmarks.harness.memory import peak_memory, reset_peak_memory
from benchmarks.opponents import CONTESTANTS


def store(contestant, task: str, results, path: str) -> None:
    """Write a task's results, in SI units, as the arrays of an NPZ file."""
    if hasattr(contestant, "in_si"):
        results = contestant.in_si(task, results)
    arrays = results if isinstance(results, tuple) else (results,)
    np.savez(path, *[np.asarray(array) for array in arrays])


def answer(contestant, command: dict) -> dict:
    """Execute one command: `describe`, `first`, `time`, `probe` (a call's time and peak memory) or `save`."""
    match command["do"]:
        case "describe":
            details = getattr(contestant, "details", {})
            return {"tasks": list(contestant.tasks), "description": contestant.description, "details": details}
        case "first":
            start = time.perf_counter()
            results = contestant.tasks[command["task"]](0)
            seconds = time.perf_counter() - start
            if "path" in command:
                store(contestant, command["task"], results, command["path"])
            return {"seconds": seconds}
        case "probe":
            reset_peak_memory()
            start = time.perf_counter()
            contestant.tasks[command["task"]](1)
            return {"seconds": time.perf_counter() - start, "peak": peak_memory()}
        case "time":
            run, seconds = contestant.tasks[command["task"]], []
            if command["warm"]:
                run(command["round"])
            for call in range(command["calls"]):
                start = time.perf_counter()
                run(command["round"] + call + 1)
                seconds.append(time.perf_counter() - start)
            return {"seconds": seconds}
        case "save":
            store(contestant, command["task"], contestant.tasks[command["task"]](0), command["path"])
            return {}
    raise ValueError(f"Unknown command {command!r}.")


def main() -> None:
    """Answer commands until standard input closes."""
    name, path = sys.argv[1:]
    # Output printed by a library must not mix with the answers.
    channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    try:
        module, kind, arguments = CONTESTANTS[name]
        with np.load(Path(path)) as arrays:
            problem = {key: arrays[key] for key in arrays.files}
        contestant = getattr(importlib.import_module(module), kind)(problem, *arguments)
        print(json.dumps({"ready": True}), file=channel, flush=True)
        for line in sys.stdin:
            print(json.dumps(answer(contestant, json.loads(line))), file=channel, flush=True)
    except Exception as error:
        traceback.print_exc()
        print(json.dumps({"error": f"{type(error).__name__}: {error}"}), file=channel, flush=True)
        raise SystemExit(1) from error


if __name__ == "__main__":
    main()
