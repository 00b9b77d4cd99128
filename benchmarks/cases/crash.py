"""Commands killed by `kill -9` at random moments: whether the remaining files can be read, and whether the next run
gives the same result as an undisturbed run.

Half of the moments are drawn from the whole running time of a command, half from the time in which the command writes.
Studies are resumed after every kill, on the same store, until they end. Other commands are run again from the beginning
after every few kills.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.timing import say
from benchmarks.problems.killed_commands import Command, study, tank, unreadable, watch

# Number of kills of a study, of another command, and of any command in a quick run.
KILLS, FEWER, QUICK = 30, 10, 1
# Number of kills after which a command that cannot be resumed runs to its end.
ANEW = 5
HEADER = ["command", "kills", "while it wrote", "readable after", "runs that ended after", "equal to undisturbed"]


class Survived(NamedTuple):
    """Numbers of kills, of kills after the command had begun to write, of kills that left readable files, of completed
    runs, of runs with the same bytes as an undisturbed run, and a list of faults.
    """

    kills: int
    writing: int
    readable: int
    ends: int
    equal: int
    wrong: list[str]


def run(options: Options) -> Result:
    """Kill every command at random moments."""
    kills, random = QUICK if options.quick else KILLS, np.random.default_rng(0)
    rows, asked, wrong = [], [], []
    with tempfile.TemporaryDirectory() as name:
        for found, command in _survive_all(Path(name), kills, random, quick=options.quick):
            rows.append(
                [
                    f"`jeit {command.name}`",
                    str(found.kills),
                    str(found.writing),
                    f"{found.readable} of {found.kills}",
                    str(found.ends),
                    f"{found.equal} of {found.ends}",
                ]
            )
            say(" | ".join(rows[-1]))
            wrong += found.wrong
            right = found.readable == found.kills and found.equal == found.ends > 0
            asked.append(judged(f"{command.name}: all readable, all equal", rows[-1][3] + ", " + rows[-1][5], right))
    return Result([Table(HEADER, rows)], asked, wrong=wrong)


def _survive_all(folder: Path, kills: int, random: np.random.Generator, *, quick: bool):
    """Yield each command with its result. A quick run kills a study only: tests kill the other commands."""
    embedded = study(folder / "embedded", "study run")
    yield survive_resumed(embedded, kills, random), embedded
    if quick:
        return
    from distributed import Client, LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster, Client(cluster):
        command = study(folder / "cluster", "study run --scheduler", cluster.scheduler_address)
        yield survive_resumed(command, kills, random), command
    commands = tank(folder / "tank")
    others = [commands["stream"], commands["reconstruct"], commands["compiling"], watch(folder / "sheet")]
    for command in others:
        yield survive_anew(command, min(kills, FEWER), random), command


def survive_resumed(command: Command, kills: int, random: np.random.Generator) -> Survived:
    """Kill and resume a command until it ends, and repeat this from the beginning until it has been killed `kills`
    times."""
    from jeit.design.study import read_study, study_progress

    begun, span, whole = command.whole()
    command.clear(all=True)
    sweep, store = read_study(command.folder / "study.toml"), command.output
    killed = writing = readable = ends = equal = 0
    wrong: list[str] = []
    while killed < kills or not ends:
        moment = Moment.draw(random, begun, span) if killed < kills else None
        done = run_until(command, moment, again=store.exists())
        if done != "ended":
            killed += 1
            writing += done == "killed while it wrote"
            readable += _reads(lambda: study_progress(sweep, store) if store.exists() else None, wrong)
            continue
        ends += 1
        same = command.written() == whole and not [*store.parent.glob(".study.zarr*")]
        equal += same
        wrong += [] if same else [f"{command.name}: after {killed} kills the store is another"]
        command.clear(all=True)
    return Survived(killed, writing, readable, ends, equal, wrong)


def survive_anew(command: Command, kills: int, random: np.random.Generator) -> Survived:
    """Kill a command `kills` times in the same folder, and let it run to its end after every few kills."""
    command.clear(all=True)
    begun, span, whole = command.whole()
    killed = writing = readable = ends = equal = 0
    wrong: list[str] = []
    while killed < kills:
        command.clear()
        moment = Moment.draw(random, begun, span)
        done = run_until(command, moment)
        if done == "ended":
            continue
        killed += 1
        writing += done == "killed while it wrote"
        broken = unreadable(command.output)
        readable += not broken
        wrong += [f"{command.name}: killed at {moment}: {one}" for one in broken]
        if killed % ANEW and killed < kills:
            continue
        run_until(command, None)  # with the files that the killed runs left, including caches
        ends += 1
        same = command.written() == whole
        equal += same
        wrong += [] if same else [f"{command.name}: after {killed} kills the files are others"]
    return Survived(killed, writing, readable, ends, equal, wrong)


class Moment(NamedTuple):
    """Moment of a kill: seconds after the start of a command or, if `writing`, after the command has begun to write."""

    seconds: float
    writing: bool

    @classmethod
    def draw(cls, random: np.random.Generator, begun: float, span: float) -> Moment:
        """Draw a random moment in the whole running time of a command, or in the time in which the command writes."""
        writing = bool(random.random() < 0.5)
        return cls(float(random.uniform(0.0, span - begun if writing else span)), writing)


def run_until(command: Command, moment: Moment | None, *, again: bool = False) -> str:
    """Run a command, and kill it at the `moment`. Returns "ended" if the command ended before, "killed", or "killed
    while it wrote"."""
    stamp, start = time.time(), time.perf_counter()
    process = command.start(again=again)
    wrote = False
    while moment is not None and process.poll() is None:
        wrote = wrote or command.writes(stamp)
        if moment.writing and not wrote:
            start = time.perf_counter()
        if time.perf_counter() - start >= moment.seconds:
            process.kill()
            process.communicate()
            return "killed while it wrote" if wrote or command.writes(stamp) else "killed"
        time.sleep(0.005)
    command.ended(process)
    return "ended"


def _reads(read: Callable[[], object], wrong: list[str]) -> bool:
    try:
        read()
    except Exception as error:  # any message about damaged files
        wrong.append(f"{type(error).__name__}: {error}")
        return False
    return True


CASE = Case("crash", "commands killed at random moments: the remaining files, and the result of the next run", run, 20)
