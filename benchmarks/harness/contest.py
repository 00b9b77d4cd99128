"""Contestants in their processes, their turns interleaved, and what they needed: time, compile time, memory."""

from __future__ import annotations

import json
import os
import queue
import statistics
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
# After its last task a pool of BLAS threads spins for a while: let it fall asleep before the next one's turn.
REST = 0.06
TURN = 0.1
CORES = 2
# A call this long, in seconds, is timed alone and not warmed up for.
SLOW = 1.0
# A first call this long, in seconds, is not compilation, and is not repeated.
LONG = 60.0


class GaveUpError(Exception):
    """A contestant took longer than its limit, ran out of memory or failed."""


@dataclass
class Figures:
    """What one contestant needed for one task."""

    seconds: list[float] = field(default_factory=list)
    first: float = 0.0
    peak: float | None = None
    remark: str = ""

    @property
    def median(self) -> float:
        """Median time of one repeat in seconds; NaN if it gave up."""
        return statistics.median(self.seconds) if self.seconds else float("nan")

    @property
    def compile(self) -> float:
        """What the first call took beyond a later one: compilation, in seconds."""
        return max(self.first - self.median, 0.0) if self.seconds else float("nan")


class Contestant:
    """A worker process and a limit on the time of each of its answers."""

    def __init__(self, name: str, problem: Path, limit: float, interpreter: str):
        self.name, self.limit = name, limit
        environment = dict(os.environ)
        for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            environment[variable] = str(CORES)
        self._process = subprocess.Popen(
            [interpreter, "-m", "benchmarks.harness.worker", name, str(problem)],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answers: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()
        self._receive(max(limit, 120))
        description = self.ask(do="describe")
        self.tasks, self.description = description["tasks"], description["description"]

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
        """Send a command, wait for its answer. Raises `GaveUpError`."""
        if self._process.poll() is not None:
            raise GaveUpError("not running")
        self._process.stdin.write(json.dumps(command) + "\n")  # pyright: ignore[reportOptionalMemberAccess]
        self._process.stdin.flush()  # pyright: ignore[reportOptionalMemberAccess]
        return self._receive(self.limit)

    def save(self, task: str, path: Path) -> list[np.ndarray]:
        """Results of a task for the first conductivity."""
        self.ask(do="save", task=task, path=str(path))
        with np.load(path) as arrays:
            results = [arrays[name] for name in arrays.files]
        path.unlink()
        return results

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def _probe(name, result, contestants, task) -> float:
    """About how long a repeat takes, in seconds, once what is compiled is compiled."""
    if result.first > LONG:
        return result.first
    contestant = next(one for one in contestants if one.name == name)
    return contestant.ask(do="time", task=task, round=0, calls=1, warm=result.first < SLOW)["seconds"][0]


def compete(
    contestants: list[Contestant], task: str, *, rounds: int, budget: float, folder: Path | None = None
) -> dict[str, Figures]:
    """Median times of a task, the contestants taking turns so that a drifting machine is unfair to none.

    Each turn makes as many calls as fit in `TURN` seconds (at most 25), after one that is not timed. `budget`:
    seconds a contestant may use in all; a slow one gets fewer rounds, at least one (its first, if that is very long).
    `folder`: where to leave the results of the first conductivity, NAME.npz.
    """
    figures = {}
    saved = {} if folder is None else {one.name: {"path": str(folder / f"{one.name}.npz")} for one in contestants}
    for contestant in contestants:
        if task not in contestant.tasks:
            continue
        figures[contestant.name] = result = Figures()
        try:
            result.first = contestant.ask(do="first", task=task, **saved.get(contestant.name, {}))["seconds"]
            if result.first > LONG:
                result.seconds = [result.first]
        except GaveUpError as reason:
            result.remark = str(reason)
    expected = {name: _probe(name, result, contestants, task) for name, result in figures.items() if not result.remark}
    for turn in range(rounds):
        for contestant in contestants:
            name = contestant.name
            result = figures.get(name)
            if result is None or result.remark or (result.seconds and sum(result.seconds) > budget):
                continue
            slow = expected[name] > SLOW
            calls = 1 if slow else int(np.clip(TURN / expected[name], 1, 25))
            time.sleep(REST)
            try:
                taken = contestant.ask(do="time", task=task, round=turn * calls, calls=calls, warm=not slow)
            except GaveUpError as reason:
                result.remark = str(reason)
                continue
            result.seconds += taken["seconds"]
    for contestant in contestants:
        result = figures.get(contestant.name)
        if result is not None and not result.remark and result.median < 20:
            try:
                result.peak = contestant.ask(do="memory", task=task)["peak"]
            except GaveUpError as reason:
                result.remark = str(reason)
    return figures
