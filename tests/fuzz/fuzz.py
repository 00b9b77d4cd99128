"""Change files at random, read them, and count the outcomes: `python tests/fuzz/fuzz.py --inputs 100000`.

Every input is identified by its reader and number, which reproduce it: `--reader study --first 31 --inputs 1`.
"""

import argparse
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from commands import COMMANDS, READERS
from mutators import mutated
from oracle import Outcome, outcome
from readers import Reader


def changed_files(reader: Reader, number: int) -> dict[str, bytes]:
    """Input `number` of a reader: its valid files, one of them changed, in most cases the main file."""
    random = Random(f"{reader.name} {number}")
    files = dict(reader.files)
    others = sorted(files)
    chosen = reader.main if reader.main in files and random.random() < 0.8 else random.choice(others)
    files[chosen] = mutated(chosen, files[chosen], random)
    return files


def tried(reader: Reader, numbers: range, seconds: float = 60.0) -> Iterator[tuple[int, Outcome]]:
    """The outcome of each of these inputs."""
    for number in numbers:
        with tempfile.TemporaryDirectory() as folder:
            for name, content in changed_files(reader, number).items():
                path = Path(folder) / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            before = {str(one) for one in Path(folder).rglob("*")}
            came = outcome(lambda folder=folder: reader.use(Path(folder)), seconds)
            left = {str(one) for one in Path(folder).rglob("*")} - before
            if left and reader.name != "store of a study":
                came = Outcome("left files", ", ".join(sorted(left)), came.seconds)
            yield number, came


def main() -> int:
    """Print a table of counts and every fault; return 1 if there is any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=2000, help="of all readers together")
    parser.add_argument("--reader", choices=[*READERS], action="append")
    parser.add_argument("--files", action="store_true", help="readers of files alone")
    parser.add_argument("--commands", action="store_true", help="commands alone")
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    given = parser.parse_args()
    left_out = {"": {}, "files": COMMANDS, "commands": {name for name in READERS if name not in COMMANDS}}
    without = left_out["files" if given.files else "commands" if given.commands else ""]
    chosen = [READERS[name] for name in given.reader or READERS if name not in without]
    each, faults = -(-given.inputs // len(chosen)), []
    print(f"{'reader':26}{'tried':>8}{'refused':>9}{'accepted':>9}{'faults':>8}{'slowest':>9}")
    for reader in chosen:
        counts, slowest = Counter(), 0.0
        for number, came in tried(reader, range(given.first, given.first + each)):
            counts["faulty" if came.faulty else came.kind] += 1
            slowest = max(slowest, came.seconds)
            if came.faulty:
                faults.append(f"{reader.name} {number}: {came.kind}: {came.message}")
        row = [each, counts["refused"], counts["accepted"], counts["faulty"]]
        print(f"{reader.name:26}" + "".join(f"{one:>{8 + (place in (1, 2))}}" for place, one in enumerate(row)), end="")
        print(f"{slowest:>7.1f} s", flush=True)
    for fault in faults:
        print(fault)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
