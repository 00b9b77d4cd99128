"""Randomly corrupted files are given to every reader and to some commands: a file is accepted, refused with one clear
error, or causes a fault."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from benchmarks.harness.case import Case, Options, Result, Table, judged
from benchmarks.harness.timing import say

ROOT = Path(__file__).resolve().parents[2]
# Number of corrupted files for readers (200 for each reader), for commands (a second each), and for readers in a quick
# run.
FILES, COMMANDS, QUICK = 6200, 200, 310
HEADER = ["reader or command", "tried", "one clear error", "accepted", "faults", "slowest"]


def run(options: Options) -> Result:
    """Corrupt files for readers and for commands, by the fuzzer's own command."""
    counts = [("--files", QUICK)] if options.quick else [("--files", FILES), ("--commands", COMMANDS)]
    rows, wrong = [], []
    for which, number in counts:
        found, faults = _fuzzed(which, number)
        rows += found
        wrong += faults
    tried, faults = (sum(int(row[column]) for row in rows) for column in (1, 4))
    slowest = max(float(row[5].split()[0]) for row in rows)
    asked = [
        judged("no fault", f"{faults} of {tried:,}", faults == 0),
        judged("each within 60 s", f"{slowest:.1f} s", slowest < 60),
    ]
    return Result([Table(HEADER, rows)], asked, wrong=wrong)


def _fuzzed(which: str, number: int) -> tuple[list[list[str]], list[str]]:
    """The rows that the fuzzer prints, and the faults that it lists after them."""
    command = [sys.executable, str(ROOT / "tests" / "fuzz" / "fuzz.py"), which, "--inputs", str(number)]
    completed = subprocess.run(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False
    )
    rows, faults = [], []
    for line in completed.stdout.splitlines():
        words = line.rsplit(maxsplit=6)
        if len(words) == 7 and words[-1] == "s" and words[1].isdigit():
            rows.append([*words[:5], f"{words[5]} s"])
            say(" | ".join(rows[-1]))
        elif rows and line:
            faults.append(line)
    if not rows:
        raise RuntimeError(f"the fuzzer ended with {completed.returncode} and printed no row")
    return rows, faults


CASE = Case("fuzz", "randomly corrupted files: refused in one clear error, accepted, or a fault", run, 5)
