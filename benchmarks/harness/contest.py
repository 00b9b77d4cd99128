"""Contests of contestants in separate processes with interleaved turns, which measure time, compile time and memory."""

from __future__ import annotations

import contextlib
import json
import queue
import statistics
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.harness.machine import ROOT

# After its last task, a pool of BLAS threads occupies the processor for a while; this pause in seconds lets it sleep
# before the next turn.
REST = 0.06
TURN = 0.1
# A call that takes longer than this, in seconds, is timed alone, without a warm-up call.
SLOW = 1.0
# A first call that takes longer than this, in seconds, is not counted as compilation, and is not repeated.
LONG = 60.0


class GaveUpError(Exception):
    """A contestant exceeded its limit, ran out of memory or failed."""


@dataclass
class Figures:
    """The figures of one contestant for one task: seconds of each call, seconds of the first call, and peak memory in
    MB.

    `remark`: reason why there are no figures.
    """

    seconds: list[float] = field(default_factory=list)
    first: float = 0.0
    peak: float | None = None
    remark: str = ""

    @property
    def median(self) -> float:
        """Median time of one repeat in seconds; NaN if the contestant gave up."""
        return statistics.median(self.seconds) if self.seconds else float("nan")

    @property
    def compile(self) -> float:
        """Compile time in seconds: the time of the first call minus that of a later call."""
        return max(self.first - self.median, 0.0) if self.seconds else float("nan")


class Contestant:
    """A worker process and a limit, in seconds, on the time of each of its answers."""

    def __init__(self, name: str, problem: Path, limit: float, interpreter: str = sys.executable):
        self.name, self.limit = name, limit
        self._process = subprocess.Popen(
            [interpreter, "-m", "benchmarks.harness.worker", name, str(problem)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answers: queue.Queue[str] = queue.Queue()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self._receive(max(limit, 120))
        described = self.ask(do="describe")
        self.tasks, self.description, self.details = (described[key] for key in ("tasks", "description", "details"))

    def _listen(self):
        for line in self._process.stdout:  # pyright: ignore[reportOptionalIterable]
            self._answers.put(line)
        self._answers.put(json.dumps({"error": "out of memory or crashed"}))

    def _receive(self, limit):
        try:
            answer = json.loads(self._answers.get(timeout=limit))
        except queue.Empty:
            self.close()
            raise GaveUpError(f"> {limit:.0f} s") from None
        if "error" in answer:
            self.close()
            raise GaveUpError(answer["error"])
        return answer

    def ask(self, **command) -> dict:
        """Send a command to the worker process and return the answer. Raises `GaveUpError` if there is none within the
        limit."""
        if self._process.poll() is not None:
            raise GaveUpError("not running")
        try:
            self._process.stdin.write(json.dumps(command) + "\n")  # pyright: ignore[reportOptionalMemberAccess]
            self._process.stdin.flush()  # pyright: ignore[reportOptionalMemberAccess]
        except OSError:
            raise GaveUpError("out of memory or crashed") from None
        return self._receive(self.limit)

    def save(self, task: str, path: Path) -> list[np.ndarray]:
        """Let the contestant save the results of a task for the first conductivity, and return them."""
        self.ask(do="save", task=task, path=str(path))
        results = results_in(path)
        path.unlink()
        return results

    def close(self) -> None:
        """End the worker process."""
        self._process.kill()
        self._process.wait()
        self._listener.join()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # pyright: ignore[reportOptionalMemberAccess]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def results_in(path: Path) -> list[np.ndarray]:
    """Read the arrays that a contestant has saved."""
    with np.load(path) as arrays:
        return [arrays[name] for name in arrays.files]


def compete(
    contestants: list[Contestant], task: str, *, rounds: int, budget: float, folder: Path | None = None
) -> dict[str, Figures]:
    """Measure the times of a task. Contestants take turns, so that changes of the machine's speed affect all of them.

    Each turn makes as many calls as fit in `TURN` seconds (at most 25), after one call that is not timed. `budget`:
    seconds that a contestant may use in all rounds. A slow contestant has fewer rounds, at least one round (the first
    call, if it is very long). `folder`: folder for the results of the first conductivity, NAME.npz.
    """
    playing = [one for one in contestants if task in one.tasks]
    figures = {one.name: _begin(one, task, folder) for one in playing}
    expected = {one.name: _probe(one, task, figures[one.name]) for one in playing}
    for turn in range(rounds):
        for contestant in playing:
            result = figures[contestant.name]
            if result.remark or (result.seconds and sum(result.seconds) > budget):
                continue
            slow = expected[contestant.name] > SLOW
            calls = 1 if slow else int(np.clip(TURN / expected[contestant.name], 1, 25))
            time.sleep(REST)
            try:
                taken = contestant.ask(do="time", task=task, round=turn * calls, calls=calls, warm=not slow)
            except GaveUpError as reason:
                result.remark = str(reason)
                continue
            result.seconds += taken["seconds"]
    return figures


def _begin(contestant: Contestant, task: str, folder: Path | None) -> Figures:
    """Figures with the time of the first call of a task, whose results are saved in the folder."""
    saved = {} if folder is None else {"path": str(folder / f"{contestant.name}.npz")}
    try:
        first = contestant.ask(do="first", task=task, **saved)["seconds"]
    except GaveUpError as reason:
        return Figures(remark=str(reason))
    return Figures([first] if first > LONG else [], first)


def _probe(contestant: Contestant, task: str, result: Figures) -> float:
    """The approximate time of a repeat after compilation, in seconds. Records the peak memory in `result`.

    A slow call counts as a repeat.
    """
    if result.remark or result.seconds:
        return result.first
    try:
        probe = contestant.ask(do="probe", task=task)
    except GaveUpError as reason:
        result.remark = str(reason)
        return result.first
    result.peak = probe["peak"]
    if probe["seconds"] > SLOW:
        result.seconds = [probe["seconds"]]
    return probe["seconds"]
